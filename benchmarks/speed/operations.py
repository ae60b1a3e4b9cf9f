"""How large a traced program is, which tests keep from growing."""

from collections.abc import Iterator

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from infogoal_jax.runner.compilation import inner_programs


def operations(program: Jaxpr | ClosedJaxpr, platform: str | None = None) -> int:
    """Equations of a jaxpr, with those of inner functions and loop bodies counted wherever they stand; of what is
    written for several kinds of devices, the form for this one alone, since the others are not compiled.

    platform: "cpu" or "cuda"; None for the devices in use.
    """
    platform = platform or {"gpu": "cuda"}.get(jax.default_backend(), jax.default_backend())
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    return sum(
        1 + sum(operations(inner, platform) for inner in compiled_programs(equation, platform))
        for equation in jaxpr.eqns
    )


def compiled_programs(equation: JaxprEqn, platform: str) -> Iterator[Jaxpr | ClosedJaxpr]:
    """The inner jaxprs of an equation, without those that are for other devices."""
    platforms = equation.params.get("branches_platforms")
    if platforms is None:
        for value in equation.params.values():
            yield from inner_programs(value)
    else:
        branches = zip(equation.params["branches"], platforms, strict=True)
        yield next(branch for branch, names in branches if names is None or platform in names)
