"""Which tasks, methods and agents go together. Every refusal stands here once, for training and for the table of
`infogoal methods`.

Rules look at the parts of a configuration and at a few traits of its task, which are known before anything is loaded or
compiled; of an environment that was loaded, or made by hand, `traits_seen` reads them off.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from infogoal_jax import agents, exploration, learners
from infogoal_jax.config import TrainConfig
from infogoal_jax.envs.embodied_qa import EmbodiedQAConfig
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.envs.object_manipulation import ObjectManipulationConfig
from infogoal_jax.envs.object_search import ObjectSearchConfig
from infogoal_jax.errors import require
from infogoal_jax.learners.learner import Learner, no_loss, no_reward

STEERING = ("hrac",)
"""Agents whose actions are target states, for a low level to reach. The others choose among a few moves."""


class Traits(NamedTuple):
    """What decides what a task can be combined with.

    finite_goals: whether goals are a finite set; image_goals: whether they are images; moves: whether an action is a
    choice among a few;
    finite_observations: whether there is a list of all that can be seen; recorded: whether learning is from recorded
    moves alone;
    target_states: whether a low level could be sent somewhere.
    """

    finite_goals: bool
    image_goals: bool
    moves: bool
    finite_observations: bool
    recorded: bool
    target_states: bool


TRAITS: dict[type, Callable[[Any], Traits]] = {
    ObjectSearchConfig: lambda env: Traits(
        True, image_goals=False, moves=True, finite_observations=True, recorded=False, target_states=False
    ),
    EmbodiedQAConfig: lambda env: Traits(
        True, image_goals=False, moves=True, finite_observations=True, recorded=True, target_states=False
    ),
    ObjectManipulationConfig: lambda env: Traits(
        True, image_goals=True, moves=True, finite_observations=False, recorded=False, target_states=True
    ),
    FetchConfig: lambda env: Traits(
        env.goals == "images",
        env.goals == "images",
        moves=False,
        finite_observations=False,
        recorded=False,
        target_states=True,
    ),
}
"""Traits of each kind of task by its configuration. A task that is not listed is with_rewards once it is loaded."""


def traits_seen(env) -> Traits:
    """The traits of an environment that was loaded or made by hand."""
    return Traits(
        finite_goals=env.goals is not None,
        image_goals=env.train_backgrounds is not None,
        moves=env.discrete,
        finite_observations=env.num_observations is not None,
        recorded=env.recorded is not None,
        target_states=env.has_target_states,
    )


class Refusal(NamedTuple):
    """Why a configuration makes no sense: the field that is to blame and its value, the reason in few words, and what
    to give instead."""

    field: str
    value: Any
    reason: str
    remedy: str


def make_learner(config: TrainConfig) -> Learner:
    """The learner that the configuration names."""
    return learners.registry.entry_of(config.learner).make(config.learner)


def has_own_loss(learner: Learner) -> bool:
    """Whether the goal encoder is trained by anything but the agent's loss."""
    return learner.loss is not no_loss


def has_reward(learner: Learner) -> bool:
    """Whether there is an intrinsic reward."""
    return learner.intrinsic_reward is not no_reward


def refusals(config: TrainConfig, traits: Traits) -> Iterator[Refusal]:
    """Everything that speaks against this configuration of a task with these traits."""
    agent = agents.registry.name_of(config.agent)
    if not traits.finite_goals:
        yield Refusal(
            "env.goals",
            getattr(config.env, "goals", None),
            f"training {config.task} needs a finite set of goals",
            "give images",
        )
    if agent in STEERING and not traits.target_states:
        yield Refusal(
            "agent",
            agent,
            "there are no target states that a low level could be sent to",
            "give dqn, or cql for recorded moves",
        )
    if agent not in STEERING and not traits.moves:
        yield Refusal(
            "agent",
            agent,
            f"{config.task} is not acted in by a choice among a few moves",
            f"give {' or '.join(STEERING)}",
        )
    explorer = exploration.registry.name_of(config.explorer)
    if explorer != "none":
        yield from refusals_of_explorer(explorer, agent, traits)
    if config.training_corruption and not traits.image_goals:
        yield Refusal(
            "training_corruption",
            config.training_corruption,
            f"goals of {config.task} are not images, which alone can be corrupted",
            "give 0",
        )
    if config.stop_encoder_gradient and not has_own_loss(make_learner(config)):
        yield Refusal(
            "stop_encoder_gradient",
            True,
            f"nothing else than the agent's loss trains the goal encoder of learner "
            f"{learners.registry.name_of(config.learner)!r}",
            "give False, or another learner",
        )


def refusals_of_explorer(explorer: str, agent: str, traits: Traits) -> Iterator[Refusal]:
    """What speaks against a bonus, which is kept for every observation and move."""
    if traits.recorded:
        yield Refusal("explorer", explorer, "a bonus cannot explore what is recorded", "give none")
    elif not traits.moves or agent in STEERING:
        yield Refusal("explorer", explorer, "actions are continuous", "its bonus is kept for each move; give none")
    if not traits.finite_observations:
        yield Refusal("explorer", explorer, "observations are no finite set", "its bonus is kept for each; give none")


def reasons_against(config: TrainConfig, env: Any = None) -> list[Refusal]:
    """Everything that speaks against training this configuration, from its parts alone, or as the environment `env`
    shows it; empty: nothing does."""
    if env is not None:
        return list(refusals(config, traits_seen(env)))
    known = TRAITS.get(type(config.env))
    return [] if known is None else list(refusals(config, known(config.env)))


def check_combination(config: TrainConfig, env: Any = None) -> None:
    """Raise `UserError` for the first of `reasons_against`."""
    for refusal in reasons_against(config, env):
        require(False, refusal.field, refusal.value, f"{refusal.reason}: {refusal.remedy}")


def check_same_task(config: TrainConfig, env: Any) -> None:
    """Raise `UserError` for an environment that is plainly of another task than the configuration."""
    known = TRAITS.get(type(config.env))
    if known is None:
        return
    should_be, seen = known(config.env), traits_seen(env.unwrapped)
    for trait in ("finite_goals", "image_goals", "moves", "finite_observations", "recorded"):
        wanted, found = getattr(should_be, trait), getattr(seen, trait)
        require(
            wanted == found,
            "env",
            type(env.unwrapped).__name__,
            f"is an environment of another task than {config.task} ({trait} is {found}, should be {wanted}); leave it "
            "out, or give one of the task",
        )


def remarks(config: TrainConfig) -> list[str]:
    """What is allowed but unusual about a configuration."""
    known = TRAITS.get(type(config.env))
    recorded = known is not None and known(config.env).recorded
    agent, found = agents.registry.name_of(config.agent), []
    if agent == "cql" and known is not None and not recorded:
        found.append("cql is meant for recorded moves: acting, it holds down the values of what it has not tried")
    if agent == "dqn" and recorded:
        found.append("dqn is meant for acting: nothing holds down the values of moves that were not recorded")
    return found
