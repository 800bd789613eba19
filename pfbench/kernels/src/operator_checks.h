// Checks of the operators' arguments. Written by `python -m pfbench.kernels.manifest` from operators.toml.
#pragma once
#include "argument_check.h"

namespace {
namespace checks {

inline void philox_normals(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    ArgumentCheck check("philox_normals");
    check.int64("seed", seed, "");
    check.integer("purpose", purpose);
    check.int64("step", step, "");
    check.int64("runs", runs, "R");
    check.integer("components", components);
    check.integer("quarters", quarters);
}

inline void philox_normals_float64(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    ArgumentCheck check("philox_normals_float64");
    check.int64("seed", seed, "");
    check.integer("purpose", purpose);
    check.int64("step", step, "");
    check.int64("runs", runs, "R");
    check.integer("components", components);
    check.integer("quarters", quarters);
}

inline void philox_uniforms(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    ArgumentCheck check("philox_uniforms");
    check.int64("seed", seed, "");
    check.integer("purpose", purpose);
    check.int64("step", step, "");
    check.int64("runs", runs, "R");
    check.integer("components", components);
    check.integer("quarters", quarters);
}

inline void resample_systematic(const Tensor& a, const Tensor& n, const Tensor& u) {
    ArgumentCheck check("resample_systematic");
    check.real("a", a, "RN", "N");
    check.number("n", n, "r1");
    check.number("u", u, "R1");
    check.range("n", n, 1, 'N', 0);
    check.range("u", u, 1, '1', 0);
}

inline void gather_particles(const Tensor& x, const Tensor& ancestors) {
    ArgumentCheck check("gather_particles");
    check.real("x", x, "DRN");
    check.int64("ancestors", ancestors, "RM");
    check.range("ancestors", ancestors, 1, 'N', 1);
}

inline void log_normal(const Tensor& y, const Tensor& mean, const Tensor& scale, const Tensor& constant) {
    ArgumentCheck check("log_normal");
    check.number("y", y, "rk");
    check.real("mean", mean, "RNK");
    check.number("scale", scale, "rk");
    check.number("constant", constant, "r");
}

inline void propagate_affine(const Tensor& phi, const Tensor& x, const Tensor& gain, const Tensor& w) {
    ArgumentCheck check("propagate_affine");
    check.real("phi", phi, "rED");
    check.real("x", x, "RND");
    check.real("gain", gain, "rEW");
    check.real("w", w, "RNW");
}

inline void gather_propagate(const Tensor& phi, const Tensor& x, const Tensor& ancestors, const Tensor& gain, const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs) {
    ArgumentCheck check("gather_propagate");
    check.real("phi", phi, "rDD");
    check.real("x", x, "DRN");
    check.int64("ancestors", ancestors, "RM");
    check.real("gain", gain, "rDW");
    check.int64("seed", seed, "");
    check.integer("purpose", purpose);
    check.int64("step", step, "");
    check.int64("runs", runs, "R");
    check.range("ancestors", ancestors, 1, 'N', 1);
}

inline void count_unique(const Tensor& ancestors, const Tensor& log_w) {
    ArgumentCheck check("count_unique");
    check.int64("ancestors", ancestors, "RN");
    check.real("log_w", log_w, "RN");
    check.range("ancestors", ancestors, 2, 'N', 1);
}

inline void sum_and_squares(const Tensor& terms) {
    ArgumentCheck check("sum_and_squares");
    check.real("terms", terms, "RN");
}

inline void weighted_moments(const Tensor& x, const Tensor& w) {
    ArgumentCheck check("weighted_moments");
    check.real("x", x, "RND");
    check.real("w", w, "RN");
}

inline void cholesky_factor(const Tensor& covariance) {
    ArgumentCheck check("cholesky_factor");
    check.real("covariance", covariance, "BDD");
}

inline void kalman_update(const Tensor& m, const Tensor& r, const Tensor& omega) {
    ArgumentCheck check("kalman_update");
    check.real("m", m, "RKD");
    check.real("r", r, "RK");
    check.real("omega", omega, "RKK");
}

inline void fit_affine(const Tensor& r, const Tensor& xi, const Tensor& w) {
    ArgumentCheck check("fit_affine");
    check.real("r", r, "RPK");
    check.real("xi", xi, "PD");
    check.real("w", w, "P");
}

inline void group_covariance(const Tensor& x, const Tensor& mean, const Tensor& w, const Tensor& groups) {
    ArgumentCheck check("group_covariance");
    check.real("x", x, "RNK");
    check.real("mean", mean, "RK");
    check.real("w", w, "RN");
    check.int64("groups", groups, "GS");
    check.range("groups", groups, 1, 'K', 1);
}

inline void squared_mahalanobis(const Tensor& e, const Tensor& covariance) {
    ArgumentCheck check("squared_mahalanobis");
    check.real("e", e, "BD");
    check.real("covariance", covariance, "BDD");
}

inline void marginal_scores(const Tensor& error, const Tensor& deviation, const Tensor& w) {
    ArgumentCheck check("marginal_scores");
    check.real("error", error, "RK");
    check.real("deviation", deviation, "RNK", "N");
    check.real("w", w, "RN");
}

inline void energy_score(const Tensor& points) {
    ArgumentCheck check("energy_score");
    check.real("points", points, "RNS");
}

}  // namespace checks
}  // namespace
