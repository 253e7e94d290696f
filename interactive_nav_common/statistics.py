"""Compute the means of samples with their intervals, and tests between samples."""

import dataclasses
import math
import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
LEVEL = 0.05
"""Of significance."""
RESAMPLES = 10_000


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A mean over runs, episodes or scenes and its 95 % interval; NaN ends where there are too few."""

    mean: float
    low: float
    high: float
    runs: int

    @property
    def bar(self) -> np.ndarray:
        """Return how far the interval reaches below and above the mean, [2, 1], for matplotlib's error bars."""
        return np.abs([[self.low - self.mean], [self.high - self.mean]])

    def with_ends(self, digits: int = 3) -> str:
        """Return the mean and the interval's ends, for tables."""
        mean, low, high = (f"{value:.{digits}f}" for value in (self.mean, self.low, self.high))
        return mean if math.isnan(self.low) else f"{mean} [{low}, {high}]"


def estimate(values: Iterable[float]) -> Estimate:
    """Return the mean and its 95 % interval by Student's t, for differences: see `over_runs` for scores."""
    x = np.asarray(list(values), float)
    if len(x) < 2:
        return Estimate(float(x.mean()) if len(x) else math.nan, math.nan, math.nan, len(x))
    half = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, len(x) - 1) * x.std(ddof=1) / math.sqrt(len(x))
    return Estimate(float(x.mean()), float(x.mean() - half), float(x.mean() + half), len(x))


def over_episodes(name: str, values: np.ndarray) -> Estimate:
    """Return the mean and its 95 % interval: Wilson's for success (0 or 1), bootstrap percentiles elsewhere."""
    mean = float(values.mean())
    if name == "success":
        test = stats.binomtest(int(values.sum()), len(values))
        result = test.proportion_ci(CONFIDENCE, method="wilson")
    elif len(values) < 2 or np.ptp(values) == 0.0:  # nothing to resample
        return Estimate(mean, mean, mean, len(values))
    else:
        how: Any = {"n_resamples": RESAMPLES, "confidence_level": CONFIDENCE, "method": "percentile"}
        result = stats.bootstrap((values,), np.mean, rng=np.random.default_rng(0), **how).confidence_interval
    return Estimate(mean, float(result.low), float(result.high), len(values))


def over_runs(values: Iterable[float]) -> Estimate:
    """Return the mean of runs' or homes' scores and its bootstrap interval over them: of three, lowest to highest."""
    x = np.asarray(list(values), float)
    return over_episodes("mean", x) if len(x) > 1 else estimate(x)


def paired_difference(left: Iterable[float], right: Iterable[float]) -> Estimate:
    """Return the mean of left minus right over the pairs (say, the episodes that both played), see `over_episodes`."""
    return over_episodes("difference", np.subtract(np.asarray(left, float), np.asarray(right, float)))


@dataclasses.dataclass(frozen=True)
class Contrast:
    """Difference of two means (left minus right) and a t test of it; NaN where there are too few runs."""

    difference: float
    low: float
    high: float
    p_value: float
    left: int
    right: int

    @property
    def verdict(self) -> str:
        """Return higher, lower or undecided, at the 5 % level."""
        if math.isnan(self.p_value) or self.p_value >= LEVEL:
            return "undecided"
        return "higher" if self.difference > 0 else "lower"

    def __str__(self) -> str:
        if math.isnan(self.p_value):
            return f"{self.difference:+.3f} ({self.left} and {self.right} runs: no test)"
        return f"{self.difference:+.3f} [{self.low:+.3f}, {self.high:+.3f}], p {p_text(self.p_value)}"


@dataclasses.dataclass(frozen=True)
class Correlation:
    """Pearson's r with its 95 % interval (Fisher's z) and p-value."""

    r: float
    low: float
    high: float
    p_value: float
    count: int

    @property
    def verdict(self) -> str:
        """Return whether they are correlated, at the 5 % level."""
        if math.isnan(self.r):
            return "too few runs to test"
        if self.p_value >= LEVEL:
            return "undecided"
        return "holds" if self.r > 0 else "does not hold: negative"

    def __str__(self) -> str:
        if math.isnan(self.r):
            return f"not defined ({self.count} points)"
        return f"{self.r:.2f} [{self.low:.2f}, {self.high:.2f}], p {p_text(self.p_value)}, n = {self.count:,}"


def p_text(p: float) -> str:
    """Return a p-value as papers print it, with its sign."""
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def _untestable(values: np.ndarray, least: int = 2) -> bool:
    """Return whether there are too few values, or no spread but rounding."""
    return len(values) < least or bool(np.ptp(values) < 1e-9)


def _tested(test: Any) -> tuple[float, float, float]:
    """Return the ends of the 95 % interval and the p-value of a test of SciPy; NaN without one."""
    if test is None:
        return math.nan, math.nan, math.nan
    interval = test.confidence_interval(CONFIDENCE)
    return float(interval.low), float(interval.high), float(test.pvalue)


def welch(a: np.ndarray, b: np.ndarray) -> Contrast:
    """Return Welch's two-sided t test of mean(a) - mean(b)."""
    test = None
    if len(a) > 1 and len(b) > 1 and not (_untestable(a) and _untestable(b)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # one side may be constant to rounding
            test = stats.ttest_ind(a, b, equal_var=False)
    return Contrast(float(np.mean(a) - np.mean(b)), *_tested(test), len(a), len(b))


def paired_test(differences: np.ndarray) -> Contrast:
    """Return the one-sample t test that the mean of differences over pairs is 0."""
    count, test = len(differences), None if _untestable(differences) else stats.ttest_1samp(differences, 0.0)
    return Contrast(float(differences.mean()), *_tested(test), count, count)


def correlation(x: Iterable[float], y: Iterable[float]) -> Correlation:
    """Return Pearson's correlation; NaN for fewer than four points or where one does not vary."""
    a, b = np.asarray(list(x), float), np.asarray(list(y), float)
    if _untestable(a, 4) or _untestable(b, 4):
        return Correlation(math.nan, *_tested(None), len(a))
    test = stats.pearsonr(a, b)
    return Correlation(float(test.statistic), *_tested(test), len(a))
