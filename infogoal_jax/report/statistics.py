"""What stands beside every number: how sure a mean over seeds is (95 % intervals of Student's t, and differences of two
methods that ran on the same seeds), and the machine that it was measured on."""

import dataclasses
import datetime
import os
import platform

import jax
import numpy as np
from scipy.special import stdtrit

from infogoal_jax import checks
from infogoal_jax.errors import require

CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean over `count` seeds, with half the width of its confidence interval; floats, or arrays [...] of one shape.

    The half width is NaN for fewer than two seeds: one seed says nothing about the others. The mean is NaN for none.
    """

    mean: np.ndarray
    half_width: np.ndarray
    count: int

    @property
    def low(self) -> np.ndarray:
        """The interval's lower end."""
        return self.mean - self.half_width

    @property
    def high(self) -> np.ndarray:
        """The interval's upper end."""
        return self.mean + self.half_width

    def show(self, decimals: int = 2) -> str:
        """`0.52 ± 0.03`; `0.52` where there is no interval; `-` where there is no seed. For a single number."""
        if not np.isfinite(self.mean):
            return "-"
        interval = f" ± {self.half_width:.{decimals}f}" if np.isfinite(self.half_width) else ""
        return f"{self.mean:.{decimals}f}{interval}"


def seeds_first(values, field: str) -> np.ndarray:
    """Numbers [seeds, ...] as float64; those of seeds that diverged may be NaN."""
    remedy = "give numbers [seeds, ...]"
    return np.asarray(checks.array(values, field, "numbers", ("seeds", ...), remedy, finite=False), float)


def mean_interval(values) -> Interval:
    """Mean and 95 % confidence interval (Student's t) over the first axis, the seeds: values [seeds, ...] to an
    interval of arrays [...]. Raises `UserError` for what are no numbers of seeds."""
    values = seeds_first(values, "values")
    count = len(values)
    if count == 0:
        nothing = np.full(values.shape[1:], np.nan)
        return Interval(nothing, nothing, 0)
    if count == 1:
        return Interval(values[0], np.full(values.shape[1:], np.nan), 1)
    standard_error = values.std(axis=0, ddof=1) / np.sqrt(count)
    return Interval(values.mean(axis=0), stdtrit(count - 1, (1 + CONFIDENCE) / 2) * standard_error, count)


def paired_difference(first, second) -> Interval:
    """Mean of `first - second` and its 95 % interval, for values [seeds, ...] of two methods on the same seeds in the
    same order.

    Seeds share the starts of evaluation and much of their luck, so that the difference is known better than either
    mean.
    Raises `UserError` if the shapes differ.
    """
    first, second = seeds_first(first, "first"), seeds_first(second, "second")
    require(
        first.shape == second.shape,
        "first, second",
        (first.shape, second.shape),
        "a paired difference needs the same seeds of both methods, [seeds, ...] of one shape",
    )
    return mean_interval(first - second)


def describe_machine() -> str:
    """Device, processor cores, versions and date, in words and without the machine's name."""
    device = jax.devices()[0]
    kind = (
        f"{os.cpu_count()} CPU cores ({platform.machine()})"
        if device.platform == "cpu"
        else f"{len(jax.devices())} x {device.device_kind}"
    )
    return f"{kind}, jax {jax.__version__}, Python {platform.python_version()}, {datetime.date.today()}"
