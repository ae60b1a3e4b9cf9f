"""What a method is: a row of the paper's Table I, which is a combination of parts."""

from typing import NamedTuple

from infogoal_jax import exploration, learners, relabelling
from infogoal_jax.errors import nearest, require


class Method(NamedTuple):
    """The names of a learner, a relabelling (None: the task's own) and an explorer."""

    learner: str
    relabelling: str | None = None
    explorer: str = "none"


METHODS = (
    {name: Method(name) for name in learners.registry}
    | {name: Method("none", name) for name in relabelling.registry if name != "none"}
    | {name: Method("none", None, name) for name in exploration.registry if name != "none"}
    | {"leo": Method("index", "all_goals")}
)
"""What can be asked for by one name. Learners, relabellings and explorers can be combined by their own names too."""
del METHODS["index"]

AGENT_FIELDS = {
    "all_goals": {"head": "product", "critic": "product", "bounded": True, "num_steps": 1},
    "index": {"head": "index"},
}
"""What a relabelling, and then a learner, changes in the configuration of an agent that has such fields."""


def method_named(name: str) -> Method:
    """The method of this name, or a `UserError` with the nearest one."""
    require(isinstance(name, str), "method", name, f"give the name of a method. Known: {', '.join(METHODS)}")
    if name in learners.registry:
        return Method(name)  # One that was registered after this module was imported, too.
    require(
        name in METHODS, "method", name, f"no such method.{nearest(name, list(METHODS))} Known: {', '.join(METHODS)}"
    )
    return METHODS[name]
