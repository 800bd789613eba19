// Written by `python -m pfbench.kernels.operator_sources` from operators.toml.
// The operators as torch calls them: checks of the arguments, registration.
#include "argument_check.h"
#include "operators.h"

namespace {
Tensor philox_normals(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    ArgumentCheck check("philox_normals");
    check.int64("seed", seed, "");
    check.integer("purpose", purpose);
    check.int64("step", step, "");
    check.int64("runs", runs, "R");
    check.integer("components", components);
    check.integer("quarters", quarters);
    return operators::philox_normals(seed, purpose, step, runs, components, quarters);
}

Tensor philox_normals_float64(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    ArgumentCheck check("philox_normals_float64");
    check.int64("seed", seed, "");
    check.integer("purpose", purpose);
    check.int64("step", step, "");
    check.int64("runs", runs, "R");
    check.integer("components", components);
    check.integer("quarters", quarters);
    return operators::philox_normals_float64(seed, purpose, step, runs, components, quarters);
}

Tensor philox_uniforms(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters) {
    ArgumentCheck check("philox_uniforms");
    check.int64("seed", seed, "");
    check.integer("purpose", purpose);
    check.int64("step", step, "");
    check.int64("runs", runs, "R");
    check.integer("components", components);
    check.integer("quarters", quarters);
    return operators::philox_uniforms(seed, purpose, step, runs, components, quarters);
}

Tensor resample_systematic(const Tensor& a, const Tensor& n, const Tensor& u) {
    ArgumentCheck check("resample_systematic");
    check.real("a", a, "RN", "N");
    check.number("n", n, "r1");
    check.number("u", u, "R1");
    check.range("n", n, 1, 'N', 0);
    check.range("u", u, 1, '1', 0);
    return operators::resample_systematic(a, n, u);
}

Tensor gather_particles(const Tensor& x, const Tensor& ancestors) {
    ArgumentCheck check("gather_particles");
    check.real("x", x, "DRN");
    check.int64("ancestors", ancestors, "RM");
    check.range("ancestors", ancestors, 1, 'N', 1);
    return operators::gather_particles(x, ancestors);
}

std::tuple<Tensor, Tensor, Tensor, Tensor> resample_particles(const Tensor& x, const Tensor& log_w, const Tensor& w, const Tensor& n, const Tensor& u, const Tensor& threshold) {
    ArgumentCheck check("resample_particles");
    check.real("x", x, "DRN", "N");
    check.real("log_w", log_w, "RN");
    check.real("w", w, "RN");
    check.number("n", n, "r1");
    check.number("u", u, "R1");
    check.number("threshold", threshold, "11");
    check.range("n", n, 1, 'N', 0);
    check.range("u", u, 1, '1', 0);
    check.range("threshold", threshold, 1, '1', 0);
    return operators::resample_particles(x, log_w, w, n, u, threshold);
}

Tensor log_normal(const Tensor& y, const Tensor& mean, const Tensor& scale, const Tensor& constant) {
    ArgumentCheck check("log_normal");
    check.number("y", y, "rk");
    check.real("mean", mean, "RNK");
    check.number("scale", scale, "rk");
    check.number("constant", constant, "r");
    return operators::log_normal(y, mean, scale, constant);
}

Tensor log_observed_normal(const Tensor& y, const Tensor& mean, const Tensor& sd) {
    ArgumentCheck check("log_observed_normal");
    check.number("y", y, "rK");
    check.real("mean", mean, "RNK");
    check.number("sd", sd, "rK");
    return operators::log_observed_normal(y, mean, sd);
}

Tensor propagate_affine(const Tensor& phi, const Tensor& x, const Tensor& gain, const Tensor& w) {
    ArgumentCheck check("propagate_affine");
    check.real("phi", phi, "rED");
    check.real("x", x, "RND");
    check.real("gain", gain, "rEW");
    check.real("w", w, "RNW");
    return operators::propagate_affine(phi, x, gain, w);
}

Tensor count_unique(const Tensor& ancestors, const Tensor& log_w) {
    ArgumentCheck check("count_unique");
    check.int64("ancestors", ancestors, "RN");
    check.real("log_w", log_w, "RN");
    check.range("ancestors", ancestors, 2, 'N', 1);
    return operators::count_unique(ancestors, log_w);
}

std::tuple<Tensor, Tensor> sum_and_squares(const Tensor& terms) {
    ArgumentCheck check("sum_and_squares");
    check.real("terms", terms, "RN");
    return operators::sum_and_squares(terms);
}

Tensor sum_log_weights(const Tensor& log_likelihood, const Tensor& log_w, const Tensor& log_ratio) {
    ArgumentCheck check("sum_log_weights");
    check.real("log_likelihood", log_likelihood, "RN");
    check.real("log_w", log_w, "Rn");
    check.real("log_ratio", log_ratio, "Rn");
    return operators::sum_log_weights(log_likelihood, log_w, log_ratio);
}

std::tuple<Tensor, Tensor, Tensor, Tensor> normalise_weights(const Tensor& log_w) {
    ArgumentCheck check("normalise_weights");
    check.real("log_w", log_w, "RN", "N");
    return operators::normalise_weights(log_w);
}

Tensor log_mixture(const Tensor& a, const Tensor& centres, const Tensor& log_w) {
    ArgumentCheck check("log_mixture");
    check.real("a", a, "RNK");
    check.real("centres", centres, "RMK", "M");
    check.real("log_w", log_w, "RM");
    return operators::log_mixture(a, centres, log_w);
}

std::tuple<Tensor, Tensor> weighted_moments(const Tensor& x, const Tensor& w) {
    ArgumentCheck check("weighted_moments");
    check.real("x", x, "RND");
    check.real("w", w, "RN");
    return operators::weighted_moments(x, w);
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> weigh_particles(const Tensor& x, const Tensor& log_w) {
    ArgumentCheck check("weigh_particles");
    check.real("x", x, "RND", "N");
    check.real("log_w", log_w, "RN");
    return operators::weigh_particles(x, log_w);
}

std::tuple<Tensor, Tensor> cholesky_factor(const Tensor& covariance) {
    ArgumentCheck check("cholesky_factor");
    check.real("covariance", covariance, "BDD");
    return operators::cholesky_factor(covariance);
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> kalman_update(const Tensor& m, const Tensor& r, const Tensor& omega) {
    ArgumentCheck check("kalman_update");
    check.real("m", m, "RKD");
    check.real("r", r, "RK");
    check.real("omega", omega, "RKK");
    return operators::kalman_update(m, r, omega);
}

std::tuple<Tensor, Tensor> fit_affine(const Tensor& r, const Tensor& xi, const Tensor& w) {
    ArgumentCheck check("fit_affine");
    check.real("r", r, "RPK");
    check.real("xi", xi, "PD");
    check.real("w", w, "P");
    return operators::fit_affine(r, xi, w);
}

Tensor group_covariance(const Tensor& x, const Tensor& mean, const Tensor& w, const Tensor& groups) {
    ArgumentCheck check("group_covariance");
    check.real("x", x, "RNK");
    check.real("mean", mean, "RK");
    check.real("w", w, "RN");
    check.int64("groups", groups, "GS");
    check.range("groups", groups, 1, 'K', 1);
    return operators::group_covariance(x, mean, w, groups);
}

Tensor squared_mahalanobis(const Tensor& e, const Tensor& covariance) {
    ArgumentCheck check("squared_mahalanobis");
    check.real("e", e, "BD");
    check.real("covariance", covariance, "BDD");
    return operators::squared_mahalanobis(e, covariance);
}

std::tuple<Tensor, Tensor> marginal_scores(const Tensor& error, const Tensor& deviation, const Tensor& w) {
    ArgumentCheck check("marginal_scores");
    check.real("error", error, "RK");
    check.real("deviation", deviation, "RNK", "N");
    check.real("w", w, "RN");
    return operators::marginal_scores(error, deviation, w);
}

Tensor energy_score(const Tensor& points) {
    ArgumentCheck check("energy_score");
    check.real("points", points, "RNS");
    return operators::energy_score(points);
}

const pfbench::Registration registration(
    pfbench::entry<&philox_normals>("philox_normals"),
    pfbench::entry<&philox_normals_float64>("philox_normals_float64"),
    pfbench::entry<&philox_uniforms>("philox_uniforms"),
    pfbench::entry<&resample_systematic>("resample_systematic"),
    pfbench::entry<&gather_particles>("gather_particles"),
    pfbench::entry<&resample_particles>("resample_particles"),
    pfbench::entry<&log_normal>("log_normal"),
    pfbench::entry<&log_observed_normal>("log_observed_normal"),
    pfbench::entry<&propagate_affine>("propagate_affine"),
    pfbench::entry<&count_unique>("count_unique"),
    pfbench::entry<&sum_and_squares>("sum_and_squares"),
    pfbench::entry<&sum_log_weights>("sum_log_weights"),
    pfbench::entry<&normalise_weights>("normalise_weights"),
    pfbench::entry<&log_mixture>("log_mixture"),
    pfbench::entry<&weighted_moments>("weighted_moments"),
    pfbench::entry<&weigh_particles>("weigh_particles"),
    pfbench::entry<&cholesky_factor>("cholesky_factor"),
    pfbench::entry<&kalman_update>("kalman_update"),
    pfbench::entry<&fit_affine>("fit_affine"),
    pfbench::entry<&group_covariance>("group_covariance"),
    pfbench::entry<&squared_mahalanobis>("squared_mahalanobis"),
    pfbench::entry<&marginal_scores>("marginal_scores"),
    pfbench::entry<&energy_score>("energy_score"));
}  // namespace
