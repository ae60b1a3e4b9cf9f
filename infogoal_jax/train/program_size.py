"""How large a traced program is: what benchmarks measure, and what a test keeps from growing."""

from collections.abc import Iterator

from jax.extend.core import ClosedJaxpr, Jaxpr


def operations(program: Jaxpr | ClosedJaxpr) -> int:
    """Equations of a jaxpr, with those of inner functions and loop bodies counted wherever they stand."""
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    return sum(
        1 + sum(operations(inner) for value in equation.params.values() for inner in inner_programs(value))
        for equation in jaxpr.eqns
    )


def inner_programs(parameter) -> Iterator[Jaxpr | ClosedJaxpr]:
    """The jaxprs among an equation's parameters."""
    if isinstance(parameter, Jaxpr | ClosedJaxpr):
        yield parameter
    elif isinstance(parameter, tuple | list):
        for part in parameter:
            yield from inner_programs(part)
