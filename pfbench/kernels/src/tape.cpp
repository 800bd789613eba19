// Steps of a bootstrap filter whose model is a tape: instructions that were recorded once (pfbench/filter/particle/tape.py).
//
// A run's particles are taken in blocks, so that all registers of the tape stay in the first-level cache. Random numbers, resampling,
// weights and moments are those of the operators, by the same code.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

#include "elementary.h"
#include "tensors.h"

// of random_normal.cpp, particles.cpp and weights.cpp
extern "C" void normals_double(double*, const int64_t*, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t);
extern "C" void uniforms(double*, const int64_t*, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t);
extern "C" bool choose_double(int64_t*, double*, const double*, const double*, double, double, int64_t);
extern "C" int64_t distinct_double(const int64_t*, const double*, int64_t);
extern "C" void sums_double(double* const*, const Product<double>*, const std::vector<int64_t>*, int64_t);
extern "C" void moments_double(double*, double*, const double*, const double*, int64_t);
extern "C" void normalise_double(double*, double*, double*, double*, const double*, int64_t);

namespace {
constexpr int64_t BLOCK = 256;
constexpr double NONE = -std::numeric_limits<double>::infinity();

// An operand: numbers of particles, or one number for all of them.
struct Operand {
    const double* at;
    int64_t across;  // 1 or 0
};

template <class F>
void each(double* __restrict out, Operand a, Operand b, int64_t n, F f) {
    if (a.across && b.across)
        for (int64_t i = 0; i < n; ++i) out[i] = f(a.at[i], b.at[i]);
    else if (a.across)
        for (int64_t i = 0; i < n; ++i) out[i] = f(a.at[i], *b.at);
    else if (b.across)
        for (int64_t i = 0; i < n; ++i) out[i] = f(*a.at, b.at[i]);
    else
        std::fill(out, out + n, f(*a.at, *b.at));
}

template <class F, class G>
void turn(double* out, Operand a, int64_t n, F f, G library) {
    bool small = true;
    for (int64_t i = 0; i < (a.across ? n : 1); ++i) small &= std::fabs(a.at[i]) <= elementary::LARGEST_ANGLE;
    small ? each(out, a, a, n, f) : each(out, a, a, n, library);
}

double remainder_of(double a, double b) {  // of the sign of b
    const double r = std::fmod(a, b);
    return r != 0 && (r < 0) != (b < 0) ? r + b : r;
}

// The instructions, in the order of OPERATIONS in tape.py. True is 1.
void execute(int64_t operation, double* out, Operand a, Operand b, Operand c, int64_t n) {
    const auto one = [&](auto f) { each(out, a, a, n, [f](double x, double) { return f(x); }); };
    const auto two = [&](auto f) { each(out, a, b, n, f); };
    switch (operation) {
        case 0: return one([](double x) { return x; });
        case 1: return two([](double x, double y) { return x + y; });
        case 2: return two([](double x, double y) { return x - y; });
        case 3: return two([](double x, double y) { return x * y; });
        case 4: return two([](double x, double y) { return x / y; });
        case 5: return one([](double x) { return -x; });
        case 6: return one([](double x) { return std::sqrt(x); });
        case 7: return one([](double x) { return elementary::exponential_or_nan(x); });
        case 8: return one([](double x) { return elementary::logarithm(x); });
        case 9: return turn(out, a, n, [](double x, double) { return elementary::circular<0>(x); }, [](double x, double) { return std::sin(x); });
        case 10: return turn(out, a, n, [](double x, double) { return elementary::circular<1>(x); }, [](double x, double) { return std::cos(x); });
        case 11: return two([](double x, double y) { return elementary::arc_tangent(x, y); });
        case 12: return two([](double x, double y) { return elementary::hypotenuse(x, y); });
        case 13: return two([](double x, double y) { return std::pow(x, y); });
        case 14: return two([](double x, double y) { return x < y || x != x ? x : y; });
        case 15: return two([](double x, double y) { return x > y || x != x ? x : y; });
        case 16: return two(remainder_of);
        case 17: return two([](double x, double y) { return x == y ? 1.0 : 0.0; });
        case 18: return two([](double x, double y) { return x != y ? 1.0 : 0.0; });
        case 19: return two([](double x, double y) { return x < y ? 1.0 : 0.0; });
        case 20: return two([](double x, double y) { return x <= y ? 1.0 : 0.0; });
        case 21: return one([](double x) { return std::fabs(x); });
        case 22: return one([](double x) { return std::rint(x); });
        case 23: return one([](double x) { return std::floor(x); });
        case 24: return one([](double x) { return std::tan(x); });
        case 25: return one([](double x) { return std::tanh(x); });
        case 26: return one([](double x) { return std::log1p(x); });
        case 27: return one([](double x) { return std::expm1(x); });
        case 28: return one([](double x) { return 0.5 * std::erfc(-0.70710678118654752440 * x); });
        default:  // the second where the first is not 0, the third elsewhere
            for (int64_t i = 0; i < n; ++i) out[i] = a.at[i * a.across] != 0 ? b.at[i * b.across] : c.at[i * c.across];
    }
}
constexpr int64_t AFFINE = 30, OPERATIONS = 31;

// Rows of `code`: operation, result and three operands. Numbers from 0 on are registers of particles: states, noise, results. ~0, ~1, ...
// are numbers of a run: constants, inputs of the step, results. A row of AFFINE is a term of its result, a number of the run times a
// register. The terms of a result are adjacent, and no adjacent one writes what another reads.
struct Tape {
    int64_t states, noises, constants, inputs, registers, numbers;
    const int64_t* code;
    int64_t rows;
    const int64_t* outputs;  // [states + 1]: the new states and the log likelihood

    void check_operand(int64_t a) const {
        require(a < registers && ~a < numbers, "run_tape: an operand must be a register or a number of the tape");
    }
    void check() const {
        require(noises >= 0 && registers >= states + noises && registers < 1 << 16 && numbers >= constants + inputs && numbers < 1 << 24,
                "run_tape: its sizes must be those of its code");
        for (const int64_t* row = code; row < code + 5 * rows; row += 5) {
            require(row[0] >= 0 && row[0] < OPERATIONS, "run_tape: an operation must be one of the tape");
            for (int k = 1; k < 5; ++k) check_operand(row[k]);
            require(row[1] >= states + noises || (row[1] < 0 && ~row[1] >= constants + inputs), "run_tape: a result must have a place of its own");
            for (int k = 2; k < 5; ++k)
                require(row[1] >= 0 || row[k] < 0, "run_tape: a number of a run must not depend on particles");
            require(row[0] != AFFINE || (row[1] >= 0 && row[2] < 0 && row[3] >= 0), "run_tape: a term must be a number times a register");
        }
        for (int64_t d = 0; d <= states; ++d) check_operand(outputs[d]);
    }
};

// A run's memory, used again for each run and step.
struct Workspace {
    std::vector<double> copies, noise, scratch, number, log_w, updated;
    const double* parents = nullptr;  // [states] rows `apart` apart: copies of the chosen ones, or the states before
    const double* drawn = nullptr;    // [noises] rows `drawn_apart` apart
    int64_t apart = 0, drawn_apart = 0;
    std::vector<int64_t> ancestors;
    std::vector<const double*> place;
    std::vector<Product<double>> terms;  // of sums that are computed together
    std::vector<int64_t> last;
    std::vector<double*> sums;
    Workspace(const Tape& tape, int64_t slots)
        : copies(tape.states * slots), noise(tape.noises * 4 * ((slots + 3) / 4)),
          scratch((tape.registers - tape.states - tape.noises) * BLOCK), number(tape.numbers), log_w(slots), updated(slots), ancestors(slots),
          place(tape.registers) {}
};

// The adjacent sums from `row` on. Returns the row after them. Zeros are left out where they multiply states and noise, which are finite.
const int64_t* add_terms(const Tape& tape, Workspace& work, const int64_t* row, int64_t n) {
    const int64_t given = tape.states + tape.noises;
    work.terms.clear(), work.last.clear(), work.sums.clear();
    for (int64_t result = -1; row < tape.code + 5 * tape.rows && row[0] == AFFINE; result = row[1], row += 5) {
        if (row[1] != result) work.sums.push_back(work.scratch.data() + (row[1] - given) * BLOCK), work.last.push_back(0);
        if (const double by = work.number[~row[2]]; by != 0 || row[3] >= given) work.terms.push_back({work.place[row[3]], by});
        work.last.back() = work.terms.size();
    }
    sums_double(work.sums.data(), work.terms.data(), &work.last, n);
    return row;
}

// New states [states] rows `plane` apart, and their log likelihoods `updated`, of one run, from its parents and its noise.
void propagate(const Tape& tape, Workspace& work, double* x, int64_t plane, int64_t slots) {
    const int64_t given = tape.states + tape.noises;
    const auto read = [&](int64_t a) { return a < 0 ? Operand{&work.number[~a], 0} : Operand{work.place[a], 1}; };
    for (int64_t first = 0; first < slots; first += BLOCK) {
        const int64_t n = std::min(BLOCK, slots - first);
        for (int64_t d = 0; d < tape.states; ++d) work.place[d] = work.parents + d * work.apart + first;
        for (int64_t d = 0; d < tape.noises; ++d) work.place[tape.states + d] = work.drawn + d * work.drawn_apart + first;
        for (int64_t k = given; k < tape.registers; ++k) work.place[k] = work.scratch.data() + (k - given) * BLOCK;
        for (const int64_t *row = tape.code, *next; row < tape.code + 5 * tape.rows; row = next) {
            next = row[0] == AFFINE ? add_terms(tape, work, row, n) : row + 5;
            if (row[0] == AFFINE || (row[1] < 0 && first > 0)) continue;  // numbers of a run are computed with the first block
            double* const out = row[1] < 0 ? &work.number[~row[1]] : work.scratch.data() + (row[1] - given) * BLOCK;
            execute(row[0], out, read(row[2]), read(row[3]), read(row[4]), row[1] < 0 ? 1 : n);
        }
        for (int64_t d = 0; d < tape.states; ++d) execute(0, x + d * plane + first, read(tape.outputs[d]), {}, {}, n);
        execute(0, work.updated.data() + first, read(tape.outputs[tape.states]), {}, {}, n);
    }
}

// Particles that are not finite get weight 0 and the state of their parent.
void deactivate(double* x, int64_t plane, Workspace& work, int64_t states, int64_t slots) {
    for (int64_t i = 0; i < slots; ++i) {
        double sum = 0;
        for (int64_t d = 0; d < states; ++d) sum += x[d * plane + i];
        if (std::isfinite(sum)) continue;
        work.updated[i] = NONE;
        for (int64_t d = 0; d < states; ++d) x[d * plane + i] = work.parents[d * work.apart + i];
    }
}

// Results of all steps, [T, R, ...], and of the kept ones, [K, ...].
struct Results {
    Tensor mean, variance, total, ess, resampled, distinct, x, log_w, w, prior;
    Results(int64_t steps, int64_t kept, int64_t states, int64_t runs, int64_t slots)
        : mean(fresh<double>({steps, runs, states})), variance(fresh<double>({steps, runs, states})), total(fresh<double>({steps, runs})),
          ess(fresh<double>({steps, runs})), resampled(fresh<bool>({steps, runs})), distinct(fresh<int64_t>({steps, runs})),
          x(fresh<double>({kept, states, runs, slots})), log_w(fresh<double>({kept, runs, slots})), w(fresh<double>({kept, runs, slots})),
          prior(fresh<double>({kept, runs, slots})) {}
    std::vector<Tensor> list() const { return {mean, variance, total, ess, resampled, distinct, x, log_w, w, prior}; }
};

// T steps from `first` on. Tensors: code int64 [I, 5], outputs int64 [D + 1], constants float64 [C], inputs of all runs float64 [T, 1, S] and
// of each float64 [T, R, U], x float64 [D, R, N], log_w and w float64 [R, N], runs int64 [R], kept int64 [K] (ascending, with the last
// step), threshold float64 [1], sizes int64 [7]: noises, registers, numbers, first, seed, purposes of offset and noise.
std::vector<Tensor> run_tape(std::vector<Tensor> given) {
    require(given.size() == 12, "run_tape: must have 12 tensors");
    constexpr int AXES[] = {2, 1, 1, 3, 3, 3, 2, 2, 1, 1, 1, 1};
    for (int k = 0; k < 12; ++k) require(given[k].dim() == AXES[k] && given[k].numel() < MAX_SIZE, "run_tape: a tensor has another shape");
    const Packed<int64_t> code(given[0]), outputs(given[1]), run(given[8]), kept(given[9]), size(given[11]);
    const Packed<double> constants(given[2]), shared(given[3]), own(given[4]), x0(given[5]), log_w0(given[6]), w0(given[7]), threshold(given[10]);
    const int64_t steps = given[4].size(0), runs = given[5].size(1), slots = given[5].size(2), rows = given[9].size(0);
    const auto is_cloud = [&](int k) { return given[k].size(0) == runs && given[k].size(1) == slots; };
    require(given[11].size(0) == 7 && given[10].size(0) == 1 && given[0].size(1) == 5 && given[1].size(0) == given[5].size(0) + 1 &&
                given[3].size(0) == steps && given[3].size(1) == 1 && given[4].size(1) == runs && is_cloud(6) && is_cloud(7) &&
                given[8].size(0) == runs && slots > 0,
            "run_tape: its tensors must have common sizes");
    const int64_t common = given[3].size(2), each = given[4].size(2);
    const Tape tape{given[5].size(0), size.data[0], given[2].size(0), common + each, size.data[1], size.data[2], code.data, given[0].size(0), outputs.data};
    tape.check();
    for (int64_t k = 0; k < rows; ++k)
        require(kept.data[k] < steps && kept.data[k] > (k ? kept.data[k - 1] : -1), "run_tape: kept must ascend below the number of steps");
    require(steps > 0 && rows > 0 && kept.data[rows - 1] == steps - 1, "run_tape: the last step must be kept");
    const int64_t plane = runs * slots, first = size.data[3], seed = size.data[4];
    const Results out(steps, rows, tape.states, runs, slots);
    Workspace work(tape, slots);
    std::vector<double> spare[2] = {std::vector<double>(tape.states * slots), std::vector<double>(tape.states * slots)}, spare_log_w(slots), spare_w(slots);
    std::copy_n(constants.data, tape.constants, work.number.data());
    work.drawn = work.noise.data(), work.drawn_apart = 4 * ((slots + 3) / 4);
    for (int64_t r = 0; r < runs; ++r) {  // all steps of a run, whose particles stay in the cache
        const int64_t from = r * slots;
        const double *x = x0.data + from, *log_w = log_w0.data + from, *w = w0.data + from;
        int64_t apart = plane;
        for (int64_t t = 0, row = 0; t < steps; ++t) {
            const bool keep = kept.data[row] == t;
            const int64_t at = t * runs + r, new_apart = keep ? plane : slots;
            double* const new_x = keep ? numbers<double>(out.x) + row * tape.states * plane + from : spare[t % 2].data();
            double* const new_log_w = keep ? numbers<double>(out.log_w) + row * plane + from : spare_log_w.data();
            double* const new_w = keep ? numbers<double>(out.w) + row * plane + from : spare_w.data();
            double offset[4];
            uniforms(offset, run.data + r, 1, 1, 1, first + t, seed, size.data[5]);
            const bool resampled = choose_double(work.ancestors.data(), work.log_w.data(), w, log_w, *offset, *threshold.data, slots);
            numbers<bool>(out.resampled)[at] = resampled;
            numbers<int64_t>(out.distinct)[at] = distinct_double(work.ancestors.data(), work.log_w.data(), slots);
            for (int64_t d = 0; resampled && d < tape.states; ++d)
                for (int64_t i = 0; i < slots; ++i) work.copies[d * slots + i] = x[d * apart + work.ancestors[i]];
            work.parents = resampled ? work.copies.data() : x, work.apart = resampled ? slots : apart;
            normals_double(work.noise.data(), run.data + r, 1, 0, tape.noises, (slots + 3) / 4, first + t, seed, size.data[6]);
            std::copy_n(own.data + at * each, each, std::copy_n(shared.data + t * common, common, work.number.data() + tape.constants));
            propagate(tape, work, new_x, new_apart, slots);
            for (int64_t i = 0; i < slots; ++i) {
                const double sum = work.updated[i] + work.log_w[i];
                work.updated[i] = sum == sum ? sum : NONE;
            }
            if (keep) std::copy_n(work.log_w.data(), slots, numbers<double>(out.prior) + row * plane + from);
            double *const mean = numbers<double>(out.mean) + at * tape.states, *const variance = numbers<double>(out.variance) + at * tape.states;
            const auto weigh = [&] {
                normalise_double(new_log_w, numbers<double>(out.total) + at, new_w, numbers<double>(out.ess) + at, work.updated.data(), slots);
                for (int64_t d = 0; d < tape.states; ++d) moments_double(mean + d, variance + d, new_x + d * new_apart, new_w, slots);
            };
            weigh();
            if (!std::isfinite(std::accumulate(mean, mean + tape.states, 0.0))) {
                deactivate(new_x, new_apart, work, tape.states, slots);
                weigh();
            }
            x = new_x, log_w = new_log_w, w = new_w, apart = new_apart, row += keep;
        }
    }
    return out.list();
}

// Paths of K steps from their starts under given noise: states [K + 1, D, R, N] and their log likelihoods [K + 1, R, N]. Tensors: code,
// outputs and constants as above, inputs float64 [K, R, U], starts float64 [D, R, N] and their log likelihoods float64 [R, N], noise
// float64 [K W, R, N], sizes int64 [3]: noises, registers, numbers.
std::vector<Tensor> run_paths(std::vector<Tensor> given) {
    require(given.size() == 8, "run_paths: must have 8 tensors");
    constexpr int AXES[] = {2, 1, 1, 3, 3, 2, 3, 1};
    for (int k = 0; k < 8; ++k) require(given[k].dim() == AXES[k] && given[k].numel() < MAX_SIZE, "run_paths: a tensor has another shape");
    const Packed<int64_t> code(given[0]), outputs(given[1]), size(given[7]);
    const Packed<double> constants(given[2]), inputs(given[3]), starts(given[4]), values(given[5]), noise(given[6]);
    const int64_t steps = given[3].size(0), states = given[4].size(0), runs = given[4].size(1), slots = given[4].size(2), plane = runs * slots;
    require(given[7].size(0) == 3 && given[0].size(1) == 5 && given[1].size(0) == states + 1 && given[3].size(1) == runs && slots > 0 &&
                given[5].size(0) == runs && given[5].size(1) == slots && given[6].size(1) == runs && given[6].size(2) == slots &&
                given[6].size(0) == steps * size.data[0],
            "run_paths: its tensors must have common sizes");
    const Tape tape{states, size.data[0], given[2].size(0), given[3].size(2), size.data[1], size.data[2], code.data, given[0].size(0), outputs.data};
    tape.check();
    const Tensor x = fresh<double>({steps + 1, states, runs, slots}), value = fresh<double>({steps + 1, runs, slots});
    std::copy_n(starts.data, states * plane, numbers<double>(x)), std::copy_n(values.data, plane, numbers<double>(value));
    Workspace work(tape, slots);
    std::copy_n(constants.data, tape.constants, work.number.data());
    work.apart = work.drawn_apart = plane;
    for (int64_t r = 0; r < runs; ++r)
        for (int64_t t = 0; t < steps; ++t) {
            double* const before = numbers<double>(x) + t * states * plane + r * slots;
            work.parents = before, work.drawn = noise.data + t * tape.noises * plane + r * slots;
            std::copy_n(inputs.data + (t * runs + r) * tape.inputs, tape.inputs, work.number.data() + tape.constants);
            propagate(tape, work, before + states * plane, plane, slots);
            std::copy_n(work.updated.data(), slots, numbers<double>(value) + ((t + 1) * runs + r) * slots);
        }
    return {x, value};
}

const pfbench::Registration registration(pfbench::entry<&run_tape>("run_tape"), pfbench::entry<&run_paths>("run_paths"));
}  // namespace
