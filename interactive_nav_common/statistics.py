"""Compute the means of samples with their intervals, and tests between samples."""

import dataclasses
import math
import warnings
from collections.abc import Iterable

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
LEVEL = 0.05
"""Of significance."""
RESAMPLES = 10_000


def interval(name: str, values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % confidence interval of a mean: Wilson's for success (0 or 1), bootstrap percentiles elsewhere."""
    if name == "success":
        test = stats.binomtest(int(values.sum()), len(values))
        result = test.proportion_ci(CONFIDENCE, method="wilson")
        return float(result.low), float(result.high)
    if len(values) < 2 or np.ptp(values) == 0.0:  # nothing to resample
        return float(values.mean()), float(values.mean())
    result = stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(result.low), float(result.high)


def mean_text(name: str, values: np.ndarray) -> str:
    """Return a mean with its `interval`, for tables."""
    low, high = interval(name, values)
    return f"{values.mean():.3f} [{low:.3f}, {high:.3f}]"


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A mean over runs and its 95 % t interval; NaN ends for fewer than two runs."""

    mean: float
    low: float
    high: float
    runs: int

    @property
    def half(self) -> float:
        """Return half the interval's width."""
        return 0.5 * (self.high - self.low)

    def __str__(self) -> str:
        return f"{self.mean:.3f}" + ("" if math.isnan(self.half) else f" ± {self.half:.3f}")


@dataclasses.dataclass(frozen=True)
class Contrast:
    """Difference of two means (left minus right) and Welch's t test of it; NaN where there are too few runs."""

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


def _constant(values: np.ndarray) -> bool:
    """Return whether there is no spread but rounding: nothing to test."""
    return bool(np.ptp(values) < 1e-9)


def p_text(p: float) -> str:
    """Return a p-value as papers print it, with its sign."""
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def estimate(values: Iterable[float]) -> Estimate:
    """Return the mean and its 95 % interval by Student's t: what three seeds support, wide as it is."""
    x = np.asarray(list(values), float)
    if len(x) < 2:
        return Estimate(float(x.mean()) if len(x) else math.nan, math.nan, math.nan, len(x))
    half = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, len(x) - 1) * x.std(ddof=1) / math.sqrt(len(x))
    return Estimate(float(x.mean()), float(x.mean() - half), float(x.mean() + half), len(x))


def welch(a: np.ndarray, b: np.ndarray) -> Contrast:
    """Return Welch's two-sided t test of mean(a) - mean(b)."""
    difference = float(np.mean(a) - np.mean(b))
    if len(a) < 2 or len(b) < 2 or (_constant(a) and _constant(b)):
        return Contrast(difference, math.nan, math.nan, math.nan, len(a), len(b))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # one side may be constant to rounding
        test = stats.ttest_ind(a, b, equal_var=False)
    interval = test.confidence_interval(CONFIDENCE)
    return Contrast(difference, float(interval.low), float(interval.high), float(test.pvalue), len(a), len(b))
