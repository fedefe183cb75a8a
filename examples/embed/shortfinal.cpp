// The C interface of shortfinal.h over the kernels of export_kernels.py.

#include "shortfinal.h"

#include <cmath>
#include <cstdint>
#include <limits>

// What export_kernels.py exports. numba's calling convention: a status, places for the result (none)
// and for an exception's description, then the arguments.
extern "C" {
int32_t shortfinal_kernel_solve(void **, void **, int64_t k, int64_t rows, int64_t size, int64_t attitudes,
                                int64_t positions, int64_t altitudes, int64_t starts, int64_t max_iterations,
                                const double *mean, const double *cov, const double *points, const double *attitude,
                                const double *position, const double *altitude, const double *start,
                                const double *lens, double *work, double *position_out, double *rotation_out,
                                double *cov_out, double *residual_out, double *jacobian_out, double *summary_out);
int32_t shortfinal_kernel_protect(void **, void **, int64_t k, int64_t rows, int64_t size, int64_t cells, double risk,
                                  double rate, double root, double fault_free, double unmonitored,
                                  const double *residual, const double *jacobian, const double *factor,
                                  const double *position, const double *rotation, const double *points,
                                  const double *lens, const int64_t *set_rows, const double *priors,
                                  const double *table, const int64_t *layout, double *work, double *out);
int32_t shortfinal_kernel_project(void **, void **, int64_t k, const double *points, const double *rotation,
                                  const double *position, const double *lens, double *px, double *jacobian,
                                  double *depth);

// The one function of numba's own that the kernels call: the strides of an array's new shape. All arrays
// that they reshape lie in one piece.
__attribute__((visibility("hidden"))) int numba_attempt_nocopy_reshape(int64_t, const int64_t *, const int64_t *,
                                                                       int64_t dims, const int64_t *shape,
                                                                       int64_t *strides, int64_t item, int) {
    for (int64_t d = dims - 1; d >= 0; item *= shape[d], --d) strides[d] = item;
    return 1;
}
}

namespace {

constexpr double NaN = std::numeric_limits<double>::quiet_NaN();
constexpr double LARGEST_SHARE = 0.5;  // of the distance, that the position's sigma may reach
constexpr int MAX_STEPS = 50;

// Numbers that the kernels work in: _work_size of pose.py and _layout of protection.py.
constexpr int solve_size(int k, int n) { return n + 4 * k * k + 39 + k + 3 * (132 + 7 * n) + 4 * k + 103 + 5; }
constexpr int PARTS = 27;
constexpr void protect_sizes(int n, int k, int64_t (&s)[PARTS]) {
    const int h = k, m = 2;
    const int sizes[PARTS] = {n * n, n, n - 6, 15, 30, 5 * h, 6 * n, 6, 36, (n - 6) * n, n * (n - 6), 5 * n, n, 30, 5,
                              m * (n - 6), m * m, m, 6 * n, n, k, 3, 9, 9, 6, h, h};
    for (int i = 0; i < PARTS; ++i) s[i] = sizes[i];
}
constexpr int protect_size(int n, int k) {
    int64_t sizes[PARTS] = {};
    protect_sizes(n, k, sizes);
    int64_t total = 15 * k;
    for (int64_t size : sizes) total += size;
    return static_cast<int>(total);
}

int rows_of(const sf_problem &p) {
    return 2 * p.points + 3 * (p.attitude != nullptr) + 3 * (p.position != nullptr) + (p.altitude != nullptr);
}

bool complete(const sf_problem *p) {
    return p && p->points >= 3 && p->points <= SF_MAX_POINTS && p->mean_px && p->cov_px && p->points_m && p->camera &&
           p->points_sigma_m >= 0.0 && std::isfinite(p->points_sigma_m);
}

void lens_of(const sf_camera &camera, double (&lens)[12]) {
    lens[0] = camera.fx, lens[1] = camera.fy, lens[2] = camera.cx, lens[3] = camera.cy;
    for (int i = 0; i < 8; ++i) lens[4 + i] = camera.distortion[i];
}

// P(chi2(dof) > x): finite sums of positive terms, exact far out (Abramowitz & Stegun 26.4.4, 26.4.5).
double survival(int dof, double x) {
    const double half = 0.5 * x;
    const bool odd = dof % 2 == 1;
    double total = odd ? std::erfc(std::sqrt(half)) : 0.0;
    double term = std::exp(-half) * (odd ? std::sqrt(half) / std::tgamma(1.5) : 1.0);
    for (int i = 0; i < dof / 2; ++i) {
        total += term;
        term *= half / (i + (odd ? 1.5 : 1.0));
    }
    return total;
}

// What chi2(dof) exceeds with probability `rate`: bisection to the last digit.
double quantile(int dof, double rate) {
    double low = 0.0, high = 1.0;
    while (survival(dof, high) > rate) high *= 2.0;
    for (int i = 0; i < 200; ++i) {
        const double middle = 0.5 * (low + high);
        (survival(dof, middle) > rate ? low : high) = middle;
    }
    return 0.5 * (low + high);
}

// The series of the regularised lower incomplete gamma function P(a, x), over x^a exp(-x) / Gamma(a + 1):
// no term is negative.
double gamma_series(double a, double x) {
    double term = 1.0, total = 1.0;
    for (int i = 1; i < 2000 && term > 1e-17 * total; ++i) total += term *= x / (a + i);
    return total;
}

// log P(chi2(dof, t^2) <= threshold) as cubic pieces over t = 0, STEP, ...: _acceptance of protection.py.
constexpr double STEP = 0.03, REACH = 20.0;
constexpr int MOST_TERMS = 1024;

double log_sum(const double *logs, int count) {
    double top = logs[0], total = 0.0;
    for (int i = 1; i < count; ++i) top = std::fmax(top, logs[i]);
    for (int i = 0; i < count; ++i) total += std::exp(logs[i] - top);
    return top + std::log(total);
}

bool fill_table(sf_monitor &m) {
    const double half = 0.5 * m.threshold;
    const int knots = static_cast<int>(std::ceil((std::sqrt(2.0 * half) + REACH) / STEP));
    const double last = (knots - 1) * STEP, largest = last * std::sqrt(0.5 * half) + half;
    const int terms = static_cast<int>(std::ceil(largest + 20.0 * std::sqrt(largest) + 60.0));
    if (knots - 1 > SF_MAX_CELLS || terms > MOST_TERMS) return false;
    double within[MOST_TERMS], density[MOST_TERMS], factorial[MOST_TERMS], logs[MOST_TERMS];
    // Logarithms of Gamma(a + 1) and of j! as running sums: std::lgamma writes a global of the C library.
    double gamma = std::log(std::tgamma(0.5 * m.dof + 1.0));
    for (int j = 0; j < terms; ++j) {
        const double a = 0.5 * m.dof + j;
        const double first = a * std::log(half) - half - gamma;
        within[j] = first + std::log(gamma_series(a, half));
        density[j] = first - std::log(2.0);
        factorial[j] = j > 0 ? factorial[j - 1] + std::log(j) : 0.0;
        gamma += std::log(a + 1.0);
    }
    double value = 0.0, slope = 0.0;
    for (int i = 0; i < knots; ++i) {
        const double t = i * STEP, mean = 0.5 * t * t, log_mean = std::log(std::fmax(mean, 1e-300));
        for (int j = 0; j < terms; ++j) logs[j] = j * log_mean - mean - factorial[j] + within[j];
        const double next = log_sum(logs, terms);
        for (int j = 0; j < terms; ++j) logs[j] += density[j] - within[j];
        const double next_slope = -2.0 * t * std::exp(log_sum(logs, terms) - next) * STEP;
        if (i > 0) {
            double *cell = m.table[i - 1];
            const double rise = next - value;
            cell[0] = value, cell[1] = slope;
            cell[2] = 3.0 * rise - 2.0 * slope - next_slope, cell[3] = slope + next_slope - 2.0 * rise;
        }
        value = next, slope = next_slope;
    }
    m.cells = knots - 1;
    return true;
}

// L of a covariance (n, n) into the block of `factor` (rows, rows) that begins at `first`.
bool cholesky(const double *cov, int n, int first, int rows, double *factor) {
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            double total = cov[i * n + j];
            for (int k = 0; k < j; ++k)
                total -= factor[(first + i) * rows + first + k] * factor[(first + j) * rows + first + k];
            if (i == j && !(total > 0.0)) return false;
            double &entry = factor[(first + i) * rows + first + j];
            entry = i == j ? std::sqrt(total) : total / factor[(first + j) * rows + first + j];
        }
    return true;
}

// A problem whose keypoints have this covariance, from a start (12,) if there is one.
bool solve(const sf_problem &p, const double *cov_px, const double *start, sf_estimate &out) {
    const int rows = rows_of(p), size = solve_size(p.points, rows);
    double work[solve_size(SF_MAX_POINTS, SF_MAX_ROWS)], lens[12], summary[5];
    lens_of(*p.camera, lens);
    void *result = nullptr, *raised = nullptr;
    // What is absent has no rows; its pointer is not followed.
    const double *some = p.mean_px;
    const int32_t failed = shortfinal_kernel_solve(
        &result, &raised, p.points, rows, size, p.attitude != nullptr, p.position != nullptr, p.altitude != nullptr,
        start != nullptr, MAX_STEPS, p.mean_px, cov_px, p.points_m, p.attitude ? p.attitude : some,
        p.position ? p.position : some, p.altitude ? p.altitude : some, start ? start : some, lens, work,
        out.position_m, out.runway_from_camera, out.cov, out.residual, out.jacobian, summary);
    if (failed) return false;
    out.status = static_cast<sf_status>(static_cast<int>(summary[0]));
    out.rows = rows;
    out.chi2 = summary[1];
    out.iterations = static_cast<int>(summary[2]);
    out.sharp_rows = static_cast<int>(summary[3]);
    out.relative_sigma = summary[4];
    return true;
}

// What a sigma of each point by itself looks like from a pose, added to cov (2K, 2K): _seen_cov of pose.py.
void widen(const sf_problem &p, const sf_estimate &pose, double *cov) {
    double lens[12], px[2], jacobian[12], depth = 0.0;
    lens_of(*p.camera, lens);
    for (int k = 0; k < p.points; ++k) {
        void *result = nullptr, *raised = nullptr;
        shortfinal_kernel_project(&result, &raised, 1, p.points_m + 3 * k, pose.runway_from_camera, pose.position_m,
                                  lens, px, jacobian, &depth);
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j) {
                double seen = 0.0;
                for (int axis = 0; axis < 3; ++axis) seen += jacobian[6 * i + axis] * jacobian[6 * j + axis];
                cov[(2 * k + i) * 2 * p.points + 2 * k + j] += p.points_sigma_m * p.points_sigma_m * seen;
            }
    }
}

bool is_rate(double rate) { return rate > 0.0 && rate < 1.0; }

}  // namespace

extern "C" {

int sf_abi_version(void) { return SF_ABI_VERSION; }

sf_status sf_estimate_pose(const sf_problem *problem, sf_estimate *out) {
    if (!out) return SF_BAD_ARGUMENT;
    out->status = SF_BAD_ARGUMENT;
    out->rows = 0;
    if (!complete(problem)) return SF_BAD_ARGUMENT;
    const sf_problem &p = *problem;
    for (int i = 0; i < 4 * p.points * p.points; ++i) out->cov_px[i] = p.cov_px[i];
    if (!solve(p, out->cov_px, p.initial, *out)) return SF_BAD_ARGUMENT;
    if (p.points_sigma_m > 0.0 && out->status <= SF_AMBIGUOUS) {
        double start[12];
        for (int i = 0; i < 12; ++i) start[i] = i < 9 ? out->runway_from_camera[i] : out->position_m[i - 9];
        widen(p, *out, out->cov_px);
        if (!solve(p, out->cov_px, start, *out)) return out->status = SF_BAD_ARGUMENT;
    }
    return out->status;
}

sf_status sf_monitor_init(sf_monitor *out, int dof, double false_alarm_rate, double integrity_risk,
                          double fault_prior) {
    if (!out || dof < 1 || dof > SF_MAX_ROWS - 6) return SF_BAD_ARGUMENT;
    if (!is_rate(false_alarm_rate) || !is_rate(integrity_risk) || !is_rate(fault_prior)) return SF_BAD_ARGUMENT;
    out->dof = dof;
    out->false_alarm_rate = false_alarm_rate;
    out->integrity_risk = integrity_risk;
    out->fault_prior = fault_prior;
    out->threshold = quantile(dof, false_alarm_rate);
    return fill_table(*out) ? SF_CONVERGED : SF_BAD_ARGUMENT;
}

sf_status sf_check(const sf_monitor *monitor, const sf_estimate *estimate, sf_verdict *out) {
    if (!monitor || !estimate || !out) return SF_BAD_ARGUMENT;
    const sf_estimate &e = *estimate;
    out->dof = e.rows - 6;
    out->statistic = out->p_value = out->threshold = NaN;
    out->decision = SF_NOT_MONITORED;
    out->reason = e.status != SF_CONVERGED                  ? SF_NO_UNIQUE_ESTIMATE
                  : out->dof <= 0 || e.sharp_rows <= 6      ? SF_NO_REDUNDANCY
                  : !(e.relative_sigma < LARGEST_SHARE)     ? SF_TOO_UNCERTAIN
                  : out->dof != monitor->dof                ? SF_OTHER_MONITOR
                                                            : SF_CHECKED;
    if (out->reason != SF_CHECKED) return SF_CONVERGED;
    out->statistic = e.chi2;
    out->p_value = survival(out->dof, e.chi2);
    out->threshold = monitor->threshold;
    out->decision = out->p_value < monitor->false_alarm_rate ? SF_DO_NOT_USE : SF_USE;
    return SF_CONVERGED;
}

sf_status sf_protect(const sf_monitor *monitor, const sf_problem *problem, const sf_estimate *estimate,
                     sf_levels *out) {
    if (!monitor || !estimate || !out || !complete(problem)) return SF_BAD_ARGUMENT;
    const sf_problem &p = *problem;
    const sf_estimate &e = *estimate;
    const int k = p.points, n = rows_of(p);
    if (e.status > SF_AMBIGUOUS) return SF_ILL_CONDITIONED;
    if (e.rows != n || n - 6 != monitor->dof) return SF_BAD_ARGUMENT;

    double factor[SF_MAX_ROWS * SF_MAX_ROWS] = {};
    int first = 2 * k;
    bool good = cholesky(e.cov_px, 2 * k, 0, n, factor);
    if (p.attitude) good = cholesky(p.attitude + 9, 3, first, n, factor) && good, first += 3;
    if (p.position) good = cholesky(p.position + 3, 3, first, n, factor) && good, first += 3;
    if (p.altitude) factor[first * n + first] = p.altitude[1];
    if (!good) return SF_ILL_CONDITIONED;

    int64_t set_rows[2 * SF_MAX_POINTS], layout[PARTS + 1] = {}, sizes[PARTS];
    double priors[SF_MAX_POINTS], lens[12], work[protect_size(SF_MAX_ROWS, SF_MAX_POINTS)], levels[25];
    double counts[SF_MAX_POINTS + 1] = {1.0};  // P(0, 1, 2, ... faults)
    for (int i = 0; i < k; ++i) {
        set_rows[2 * i] = 2 * i, set_rows[2 * i + 1] = 2 * i + 1;
        priors[i] = monitor->fault_prior;
        for (int c = i + 1; c >= 0; --c)
            counts[c] = counts[c] * (1.0 - priors[i]) + (c > 0 ? counts[c - 1] * priors[i] : 0.0);
    }
    double unmonitored = 0.0;
    for (int c = k; c >= 2; --c) unmonitored += counts[c];
    protect_sizes(n, k, sizes);
    for (int i = 0; i < PARTS; ++i) layout[i + 1] = layout[i] + sizes[i];
    lens_of(*p.camera, lens);
    void *result = nullptr, *raised = nullptr;
    const int32_t failed = shortfinal_kernel_protect(
        &result, &raised, k, n, protect_size(n, k), monitor->cells, monitor->integrity_risk,
        monitor->false_alarm_rate, std::sqrt(monitor->threshold), counts[0], unmonitored, e.residual, e.jacobian,
        factor, e.position_m, e.runway_from_camera, p.points_m, lens, set_rows, priors, monitor->table[0], layout,
        work, levels);
    if (failed) return SF_BAD_ARGUMENT;
    out->along_m = levels[0], out->cross_m = levels[1], out->vertical_m = levels[2];
    out->lateral_deg = levels[3], out->vertical_deg = levels[4];
    for (int axis = 0; axis < 5; ++axis) out->driver[axis] = static_cast<int>(levels[15 + axis]);
    return SF_CONVERGED;
}

sf_status sf_project(const sf_camera *camera, const double position_m[3], const double runway_from_camera[9],
                     int points, const double *points_m, double *px) {
    if (!camera || !position_m || !runway_from_camera || !points_m || !px || points < 0) return SF_BAD_ARGUMENT;
    double lens[12], jacobian[12], depth = 0.0;
    lens_of(*camera, lens);
    for (int i = 0; i < points; ++i) {
        void *result = nullptr, *raised = nullptr;
        shortfinal_kernel_project(&result, &raised, 1, points_m + 3 * i, runway_from_camera, position_m, lens,
                                  px + 2 * i, jacobian, &depth);
        if (!(depth > 0.0)) return SF_BEHIND_CAMERA;
    }
    return SF_CONVERGED;
}

const char *sf_status_text(sf_status status) {
    switch (status) {
        case SF_CONVERGED: return "converged";
        case SF_AMBIGUOUS: return "ambiguous";
        case SF_ILL_CONDITIONED: return "ill-conditioned";
        case SF_BEHIND_CAMERA: return "behind-camera";
        case SF_MAX_ITERATIONS: return "max-iterations";
        case SF_NON_FINITE: return "non-finite";
        case SF_BAD_ARGUMENT: return "bad-argument";
    }
    return "unknown";
}

const char *sf_decision_text(sf_decision decision) {
    switch (decision) {
        case SF_USE: return "use";
        case SF_DO_NOT_USE: return "do-not-use";
        case SF_NOT_MONITORED: return "not-monitored";
    }
    return "unknown";
}

const char *sf_reason_text(sf_reason reason) {
    switch (reason) {
        case SF_CHECKED: return "checked";
        case SF_NO_UNIQUE_ESTIMATE: return "no unique estimate to check";
        case SF_NO_REDUNDANCY: return "no redundancy";
        case SF_TOO_UNCERTAIN: return "the position is uncertain by more than half of the distance";
        case SF_OTHER_MONITOR: return "the monitor is for another number of degrees of freedom";
    }
    return "unknown";
}
}
