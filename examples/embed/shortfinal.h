/* The pose of a camera before a runway, whether to believe it, and how far it may be wrong: the solver
 * of the Python package `shortfinal` for C and C++. No Python, no allocation, no exceptions, no global
 * state: any number of threads may call it.
 *
 * Frames, axes and units as in docs/architecture.md:
 *   runway frame  metres; origin at the centre of the landing threshold, x along the landing direction, y left, z up
 *   camera frame  x right, y down, z forward
 *   pixels        the centre of the top-left pixel is (0, 0)
 *   matrices      row by row; rotations are runway_from_camera
 *   covariance    keypoints: px^2, rows u0, v0, u1, v1, ...; pose: of the increments (x, y, z, thx, thy, thz),
 *                 p + dp in metres along the runway's axes and R exp(dth) in radians about the camera's
 *   corners       near-left, near-right, far-right, far-left, as the landing pilot sees them
 *
 * Left out, beside the Python package: edge lines, excluding faults, two faults at once, solution
 * separation, the window over frames, the tracker. */
#ifndef SHORTFINAL_H
#define SHORTFINAL_H

#ifdef __cplusplus
extern "C" {
#endif

#if defined(__GNUC__)
#define SF_API __attribute__((visibility("default")))
#else
#define SF_API
#endif

enum {
    SF_ABI_VERSION = 2,
    SF_MAX_POINTS = 12,                   /* K at most */
    SF_MAX_ROWS = 2 * SF_MAX_POINTS + 7,  /* keypoints, attitude 3, position 3, altitude 1 */
    SF_MAX_CELLS = 1200
};

typedef enum {
    SF_CONVERGED = 0,       /* one physical optimum, well determined */
    SF_AMBIGUOUS = 1,       /* a second one explains the measurements about as well; the better one is given */
    SF_ILL_CONDITIONED = 2, /* a direction is left free, or a covariance is none */
    SF_BEHIND_CAMERA = 3,   /* every optimum has a point behind, or the camera under ground or upside down */
    SF_MAX_ITERATIONS = 4,  /* no start reached an optimum */
    SF_NON_FINITE = 5,      /* NaN or infinity, in the input or by overflow */
    SF_BAD_ARGUMENT = 6     /* a null pointer, a size or a rate that cannot be; nothing else was done */
} sf_status;

typedef enum {
    SF_USE = 0,          /* checked, and nothing contradicts the stated uncertainty */
    SF_DO_NOT_USE = 1,   /* checked, and the keypoints contradict the runway */
    SF_NOT_MONITORED = 2 /* could not be checked: it has not passed */
} sf_decision;

typedef enum {
    SF_CHECKED = 0,
    SF_NO_UNIQUE_ESTIMATE = 1, /* the status is not SF_CONVERGED */
    SF_NO_REDUNDANCY = 2,      /* no more rows than unknowns, or none that is sharp */
    SF_TOO_UNCERTAIN = 3,      /* the position is known no better than to half the distance */
    SF_OTHER_MONITOR = 4       /* the monitor was made for another number of degrees of freedom */
} sf_reason;

/* Pinhole camera with OpenCV's distortion: k1, k2, p1, p2, k3, k4, k5, k6; zeros where there is none. */
typedef struct {
    double fx, fy, cx, cy; /* px */
    double distortion[8];
} sf_camera;

/* What was seen. Optional measurements are NULL if there is none; they are rows like any other. Priors
 * that contradict one another are not refused: they leave a large residual. */
typedef struct {
    int points;               /* K: 3 to SF_MAX_POINTS; checking takes a fourth, or priors */
    const double *mean_px;    /* (K, 2) */
    const double *cov_px;     /* (2K, 2K) symmetric, positive definite */
    const double *points_m;   /* (K, 3) runway frame */
    const sf_camera *camera;
    const double *attitude;   /* 9 + 9: runway_from_camera, covariance in rad^2 of the turn about the camera's axes */
    const double *position;   /* 3 + 9: metres, covariance in m^2 */
    const double *altitude;   /* 1 + 1: height above the threshold and its sigma, metres */
    const double *initial;    /* 9 + 3: a start beside the solver's own, runway_from_camera and position */
    double points_sigma_m;    /* how well it is known where each point is, per axis; 0: exactly */
} sf_problem;

/* A pose, how sure it is, and what is left over. All numbers are NaN unless the status is SF_CONVERGED
 * or SF_AMBIGUOUS. */
typedef struct {
    sf_status status;
    int rows;                             /* n = 2K + priors */
    int iterations;                       /* steps tried, over all starts */
    int sharp_rows;                       /* rows whose sigma is smaller than the scale of what they measure */
    double position_m[3];
    double runway_from_camera[9];
    double cov[36];                       /* (6, 6) */
    double chi2;                          /* squared whitened residual */
    double relative_sigma;                /* of the position, over the distance to the nearest point */
    double residual[SF_MAX_ROWS];         /* (n,) whitened */
    double jacobian[SF_MAX_ROWS * 6];     /* (n, 6) whitened */
    double cov_px[4 * SF_MAX_POINTS * SF_MAX_POINTS]; /* (2K, 2K) of the keypoints, points_sigma_m as seen included */
} sf_estimate;

/* The test and the risks. Made once; read-only from then on. */
typedef struct {
    int dof;                              /* n - 6: 2 for four corners, 3 more for each attitude or position, 1 for a height */
    double false_alarm_rate;              /* share of faultless frames refused */
    double integrity_risk;                /* P(|error| > level and the frame was accepted), per axis */
    double fault_prior;                   /* P(a keypoint is faulty) */
    double threshold;                     /* of chi2 */
    int cells;
    double table[SF_MAX_CELLS][4];        /* log P(accepted) by the size of the fault */
} sf_monitor;

typedef struct {
    sf_decision decision;
    sf_reason reason;
    int dof;
    double statistic, p_value, threshold; /* NaN when not monitored */
} sf_verdict;

/* Levels that the errors of accepted frames exceed no more often than the risk, were one keypoint
 * wrong in the worst way. Infinite where there is none. `driver` by axis: the keypoint that
 * contributes most, -1: no fault, -2: more than one fault at once. */
typedef struct {
    double along_m, cross_m, vertical_m; /* x, y, z of the runway frame */
    double lateral_deg, vertical_deg;    /* as an ILS counts: from the far end; from 300 m past the threshold */
    int driver[5];
} sf_levels;

SF_API int sf_abi_version(void);

/* The most likely pose. The status is returned, and stands in `out`. */
SF_API sf_status sf_estimate_pose(const sf_problem *problem, sf_estimate *out);

/* Rates in (0, 1), of the order of 1e-3, 1e-7, 1e-4. SF_CONVERGED or SF_BAD_ARGUMENT. Takes milliseconds. */
SF_API sf_status sf_monitor_init(sf_monitor *out, int dof, double false_alarm_rate, double integrity_risk,
                                 double fault_prior);

/* May this estimate be used? SF_CONVERGED (then see out->decision) or SF_BAD_ARGUMENT. */
SF_API sf_status sf_check(const sf_monitor *monitor, const sf_estimate *estimate, sf_verdict *out);

/* Levels of an estimate and the problem it came from. Worth asking for a verdict of SF_USE: they hold for
 * frames that the test accepts. SF_CONVERGED, SF_ILL_CONDITIONED (there is no pose) or SF_BAD_ARGUMENT. */
SF_API sf_status sf_protect(const sf_monitor *monitor, const sf_problem *problem, const sf_estimate *estimate,
                            sf_levels *out);

/* Pixels (K, 2) of points (K, 3). SF_BEHIND_CAMERA if one lies behind, or beyond the range of the lens model. */
SF_API sf_status sf_project(const sf_camera *camera, const double position_m[3], const double runway_from_camera[9],
                            int points, const double *points_m, double *px);

/* In words; never NULL. */
SF_API const char *sf_status_text(sf_status status);
SF_API const char *sf_decision_text(sf_decision decision);
SF_API const char *sf_reason_text(sf_reason reason);

#ifdef __cplusplus
}
#endif
#endif
