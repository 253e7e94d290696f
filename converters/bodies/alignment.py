"""Fit scales, translation and yaw to keypoint pairs by least squares (Interactive Gibson, section III-B)."""

import dataclasses
import itertools
import math

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import fdtri  # the quantile of F, without the 0.3 s that importing scipy.stats takes

from interactive_nav_common.errors import UserError
from interactive_nav_common.rotations import wrap_angle, yaw_matrix

MIN_POINTS = 6
"""The annotators' rule (section III-B): eighteen equations for seven unknowns, so that one can be thrown out."""
MIN_SPREAD = 0.01
"""Least spread of the keypoints in a direction, as a share of the largest: below it the scale there is noise."""
PAIRS_PER_OUTLIER = 8
"""At most one gross outlier in so many pairs (rounded up) is thrown out."""
OUTLIER_P = 1e-3
"""Chance of throwing out a sound pair, all pairs taken together, where errors are Gaussian."""
MAX_SUBSETS = 3000
"""Up to so many choices of pairs to leave out are all tried; of more, `RANDOM_STARTS` random ones are refined."""
RANDOM_STARTS = 200

SYMMETRY_PERIOD_RAD = {
    "__SYM_NONE": 2 * math.pi,
    "__SYM_ROTATE_UP_2": math.pi,
    "__SYM_ROTATE_UP_4": math.pi / 2,
    "__SYM_ROTATE_UP_INF": 0.0,
}
"""Scan2CAD's `sym` word -> the turn about the vertical after which the model looks the same (0: any turn)."""


class AlignmentError(UserError):
    """Keypoints that do not determine the seven parameters; the message says why."""


@dataclasses.dataclass(frozen=True)
class Alignment:
    """CAD frame (z up) -> scan frame: `Rz(yaw) @ diag(scale) @ p + translation`."""

    scale: np.ndarray
    """(3,) along the CAD model's axes."""
    translation: np.ndarray
    """(3,) m."""
    yaw: float
    """rad, counter-clockwise from above."""
    rms_m: float
    """Root mean square point-to-point distance of the fit; nan where nothing was fitted."""
    outliers: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, bool))
    """(k,) bool: the pairs that `solve_alignment` left out; empty where it was not asked."""


def _check_spread(points: np.ndarray) -> None:
    """Refuse keypoints without extent along z, or on one line seen from above: they leave parameters undetermined."""
    centred = points - points.mean(axis=0)
    spread = np.sqrt((centred**2).mean(axis=0))
    _, singular, axes = np.linalg.svd(centred, full_matrices=False)
    largest = singular[0] / math.sqrt(len(points))
    if largest < 1e-9:
        raise AlignmentError("the keypoints coincide: no parameter but the translation is observable")
    if singular[1] / math.sqrt(len(points)) < MIN_SPREAD * largest:
        raise AlignmentError(
            f"the keypoints are collinear (along {np.round(axes[0], 2).tolist()}): scales and yaw unobservable; "
            "choose points off that line"
        )
    flat = np.flatnonzero(spread < MIN_SPREAD * largest)
    if len(flat):
        axis = "xyz"[flat[0]]
        raise AlignmentError(
            f"the keypoints have no extent along the model's {axis} axis: they are coplanar and the {axis} scale "
            "is unobservable; choose points off that plane"
        )
    _, across, directions = np.linalg.svd(centred[:, :2], full_matrices=False)
    if across[1] / math.sqrt(len(points)) < MIN_SPREAD * largest:
        raise AlignmentError(
            f"the keypoints lie in one upright plane (along {np.round(directions[0], 2).tolist()} seen from above): "
            "the horizontal scales and the yaw cannot be distinguished; choose points off that plane"
        )


def least_squares(
    p: np.ndarray, q: np.ndarray, round_model: bool = False, weights: np.ndarray | None = None
) -> Alignment:
    """Fit by least squares over all pairs, in closed form if all scales come out positive.

    For a fixed yaw, each scale is a one-dimensional regression, and the remaining variance is a quadratic form in (cos,
    sin) of the yaw. `p` (k, 3) is in the CAD frame, `q` in the scan frame, m; `weights` (k,) apply to squared
    distances.
    """
    _check_spread(p)
    share = np.full(len(p), 1.0 / len(p)) if weights is None else weights / weights.sum()
    p_mean, q_mean = share @ p, share @ q
    root = np.sqrt(share)[:, None]
    pc, qc = (p - p_mean) * root, (q - q_mean) * root
    power = (pc**2).sum(axis=0)
    (a, d), (b, e) = (qc[:, :2].T @ pc[:, :2]).tolist()
    if round_model:
        yaw = math.atan2(b - d, a + e)
        both = math.hypot(b - d, a + e) / (power[0] + power[1])
        horizontal = (both, both)
    else:
        mixed = a * b / power[0] - d * e / power[1]
        form = [[a * a / power[0] + e * e / power[1], mixed], [mixed, b * b / power[0] + d * d / power[1]]]
        c, s = np.linalg.eigh(form)[1][:, -1]
        if c * a + s * b < 0:
            c, s = -c, -s
        yaw = math.atan2(s, c)
        if c * a + s * b <= 0 or c * e - s * d <= 0:
            yaw = _best_positive_yaw(a, b, d, e, power)
        c, s = math.cos(yaw), math.sin(yaw)
        horizontal = ((c * a + s * b) / power[0], (c * e - s * d) / power[1])
    scale = np.array([*horizontal, (qc[:, 2] @ pc[:, 2]) / power[2]])
    if (scale <= 0).any():
        raise AlignmentError("the best fit mirrors the model: the keypoint pairs contradict each other")
    turn = yaw_matrix(yaw)
    translation = q_mean - turn @ (scale * p_mean)
    residual = p * scale @ turn.T + translation - q
    return Alignment(scale, translation, yaw, float(np.sqrt(share @ (residual**2).sum(axis=1))))


def apply_alignment(fit: Alignment, points: np.ndarray) -> np.ndarray:
    """Move (n, 3) points from the CAD frame to the scan frame."""
    return points * fit.scale @ yaw_matrix(fit.yaw).T + fit.translation


def _squared(fit: Alignment, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return ((apply_alignment(fit, p) - q) ** 2).sum(axis=1)


def _best_without(p: np.ndarray, q: np.ndarray, count: int, round_model: bool) -> tuple[np.ndarray, Alignment] | None:
    """Return the least trimmed squares fit without `count` pairs (Rousseeuw and Van Driessen 1999, C-steps)."""
    k = len(p)
    best: tuple[np.ndarray, Alignment] | None = None

    def offer(keep: np.ndarray) -> Alignment | None:
        nonlocal best
        try:
            fit = least_squares(p[keep], q[keep], round_model)
        except AlignmentError:
            return None
        if len(keep) == k - count and (best is None or fit.rms_m < best[1].rms_m):
            best = (keep, fit)
        return fit

    if math.comb(k, count) <= MAX_SUBSETS:
        for left_out in itertools.combinations(range(k), count):
            offer(np.delete(np.arange(k), left_out))
        return best
    rng = np.random.default_rng(0)
    for _ in range(RANDOM_STARTS):
        keep = np.sort(rng.choice(k, 5, replace=False))
        for _ in range(20):
            fit, last = offer(keep), keep
            if fit is not None:
                keep = np.sort(np.argsort(_squared(fit, p, q), kind="stable")[: k - count])
            if np.array_equal(keep, last):
                break
    return best


def _inliers(p: np.ndarray, q: np.ndarray, round_model: bool) -> np.ndarray:
    """Return (k,) bool, False for gross outliers by an F test at `OUTLIER_P`, shared among all choices of pairs."""
    k = len(p)
    every = np.ones(k, bool)
    try:
        full = (_squared(least_squares(p, q, round_model), p, q)).sum()
    except AlignmentError:
        full = math.inf  # a gross outlier can mirror the fit of all pairs
    for count in range(math.ceil(k / PAIRS_PER_OUTLIER), 0, -1):
        freedom = 3 * (k - count) - 7
        best = _best_without(p, q, count, round_model) if freedom > 0 else None
        if best is None:
            continue
        keep, fit = best
        rest = fit.rms_m**2 * len(keep)
        if rest < 1e-18 * max(float((q - q.mean(axis=0)).var()), 1e-12) * k:
            rest = 1e-18  # exact pairs: only the rounding is left
        limit = float(fdtri(3 * count, freedom, 1 - OUTLIER_P / math.comb(k, count)))
        off = np.delete(np.arange(k), keep)
        single = float(fdtri(3, freedom, 1 - OUTLIER_P / k)) * 3 * rest / freedom
        each_far = (_squared(fit, p[off], q[off]) > single).all()
        if each_far and (full - rest) / (3 * count) > limit * rest / freedom:
            every[off] = False
            return every
    return every


def solve_alignment(cad_points: np.ndarray, scan_points: np.ndarray, symmetry: str = "__SYM_NONE") -> Alignment:
    """Fit scales, translation and yaw by least squares, robust to one gross outlier in eight pairs.

    Points are (k, 3), k >= 6: unscaled and z up in the CAD frame, and the same physical points in the scan frame, m.
    `symmetry`, about the CAD frame's z axis, is a key of `SYMMETRY_PERIOD_RAD`: each pair takes the equivalent CAD
    point that fits best, and the result has the smallest yaw. `rms_m` covers the pairs that were kept.
    """
    p, q = np.asarray(cad_points, float), np.asarray(scan_points, float)
    if p.shape != q.shape or p.ndim != 2 or p.shape[1] != 3:
        raise AlignmentError(f"keypoints have shapes {p.shape} and {q.shape}, expected two equal (k, 3) arrays")
    if symmetry not in SYMMETRY_PERIOD_RAD:
        raise AlignmentError(f"symmetry is '{symmetry}', expected one of {', '.join(SYMMETRY_PERIOD_RAD)}")
    if len(p) < MIN_POINTS:
        raise AlignmentError(f"{len(p)} keypoint pairs, expected at least {MIN_POINTS}; click more points")
    if not (np.isfinite(p).all() and np.isfinite(q).all()):
        raise AlignmentError("a keypoint is not a finite number, expected coordinates in metres")
    period = SYMMETRY_PERIOD_RAD[symmetry]
    round_model = period == 0.0
    folds = 1 if round_model else round(2 * math.pi / period)
    best = _robust_fit(p, q, round_model)
    if folds > 1:
        best = _fit_equivalents(p, q, best, folds)
    if round_model or period >= 2 * math.pi - 1e-9:
        return dataclasses.replace(best, yaw=wrap_angle(best.yaw))
    yaw = wrap_angle(best.yaw, period)
    swapped = round((best.yaw - yaw) / (math.pi / 2)) % 2 == 1  # a quarter turn swaps the horizontal scales
    return dataclasses.replace(best, scale=best.scale[[1, 0, 2]] if swapped else best.scale, yaw=yaw)


def _robust_fit(p: np.ndarray, q: np.ndarray, round_model: bool) -> Alignment:
    _check_spread(p)
    keep = _inliers(p, q, round_model)
    return dataclasses.replace(least_squares(p[keep], q[keep], round_model), outliers=~keep)


def _fit_equivalents(p: np.ndarray, q: np.ndarray, first: Alignment, folds: int) -> Alignment:
    """Alternate between choosing equivalent CAD points and fitting, while the residual falls."""
    best, images = first, p
    for _ in range(10):
        turned = np.stack([p @ yaw_matrix(2 * math.pi * i / folds).T for i in range(folds)])
        closest = np.argmin([_squared(best, image, q) for image in turned], axis=0)
        images = turned[closest, np.arange(len(p))]
        try:
            fit = _robust_fit(images, q, False)
        except AlignmentError:
            break
        if fit.rms_m >= best.rms_m - 1e-12:
            break
        best = fit
    return best


def _best_positive_yaw(a: float, b: float, d: float, e: float, power: np.ndarray) -> float:
    """Return the yaw of least residual among those with two positive horizontal scales."""

    def unexplained(yaw: float) -> float:
        c, s = math.cos(yaw), math.sin(yaw)
        return -(max(c * a + s * b, 0.0) ** 2 / power[0] + max(c * e - s * d, 0.0) ** 2 / power[1])

    step = math.radians(1.0)
    start = min(np.arange(-math.pi, math.pi, step), key=unexplained)
    best = minimize_scalar(unexplained, bounds=(start - step, start + step), method="bounded")
    return wrap_angle(float(getattr(best, "x")))  # noqa: B009 (scipy's result has no static fields)
