// Written by `python -m pfbench.kernels.operator_sources` from operators.toml.
// Operators on the CPU. Their arguments have been checked.
#pragma once
#include "tensors.h"

namespace operators {
Tensor philox_normals(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters);
Tensor philox_normals_float64(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters);
Tensor philox_uniforms(const Tensor& seed, int64_t purpose, const Tensor& step, const Tensor& runs, int64_t components, int64_t quarters);
Tensor resample_systematic(const Tensor& a, const Tensor& n, const Tensor& u);
Tensor gather_particles(const Tensor& x, const Tensor& ancestors);
std::tuple<Tensor, Tensor, Tensor, Tensor> resample_particles(const Tensor& x, const Tensor& log_w, const Tensor& w, const Tensor& n, const Tensor& u, const Tensor& threshold);
Tensor log_normal(const Tensor& y, const Tensor& mean, const Tensor& scale, const Tensor& constant);
Tensor log_observed_normal(const Tensor& y, const Tensor& mean, const Tensor& sd);
Tensor propagate_affine(const Tensor& phi, const Tensor& x, const Tensor& gain, const Tensor& w);
Tensor count_unique(const Tensor& ancestors, const Tensor& log_w);
std::tuple<Tensor, Tensor> sum_and_squares(const Tensor& terms);
Tensor sum_log_weights(const Tensor& log_likelihood, const Tensor& log_w, const Tensor& log_ratio);
std::tuple<Tensor, Tensor, Tensor, Tensor> normalise_weights(const Tensor& log_w);
Tensor log_mixture(const Tensor& a, const Tensor& centres, const Tensor& log_w);
std::tuple<Tensor, Tensor> weighted_moments(const Tensor& x, const Tensor& w);
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> weigh_particles(const Tensor& x, const Tensor& log_w);
std::tuple<Tensor, Tensor> cholesky_factor(const Tensor& covariance);
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> kalman_update(const Tensor& m, const Tensor& r, const Tensor& omega);
std::tuple<Tensor, Tensor> fit_affine(const Tensor& r, const Tensor& xi, const Tensor& w);
Tensor group_covariance(const Tensor& x, const Tensor& mean, const Tensor& w, const Tensor& groups);
Tensor squared_mahalanobis(const Tensor& e, const Tensor& covariance);
std::tuple<Tensor, Tensor> marginal_scores(const Tensor& error, const Tensor& deviation, const Tensor& w);
Tensor energy_score(const Tensor& points);
}  // namespace operators
