"""The contract of an agent: a record of pure functions over features of states and codes of goals. No agent knows which
learner made the codes.

Shapes: B transitions, F features of a state, d numbers of a goal code, A actions, or numbers of an action.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.errors import require
from infogoal_jax.replay import Trajectories


class AgentTraits(NamedTuple):
    """What decides which tasks an agent can be combined with. `Entry.traits` of an agent declares them."""

    actions: Literal["moves", "vectors", "target_states"] = "moves"
    """What the agent chooses: one of a few moves; a vector in [-1, 1] that is the environment's action; or a target
    state, which a frozen low level reaches."""
    all_goals: bool = False
    """Whether its loss learns from all goals at once, `Agent.all_goals`."""
    achieved_goals: bool = False
    """Whether it learns from goals that were achieved later alone: each transition has to carry one, and what others
    carry counts as not achieved. Only transitions after which a known goal was achieved are drawn then."""
    costs: bool = False
    """Whether it learns from costs, -1 a step until the goal, and its actor from goals of its own: of relabelling
    `mixed`."""
    sigmoid: bool = False
    """Whether its values pass a sigmoid, and so lie between 0 and 1."""


@flax.struct.dataclass
class AllGoals:
    """The transitions of a batch under G goals at once."""

    weight: jax.Array
    """float32 [G], of each goal in the loss, 1 together: as much for every known goal, 0 for those that nothing is
    learned of."""
    code: jax.Array
    """float32 [G, d]. Where G is the number of goals of the task, they are all of them, in order."""
    target_code: jax.Array
    """float32 [G, d], by the target encoder."""
    reward: jax.Array
    """float32 [B, G], discounted: of the first step that achieves the goal."""
    discount: jax.Array
    """float32 [B, G], discount of what follows; 0 for a goal that the transition achieves, and for that goal alone, or
    after a failure."""


@flax.struct.dataclass
class ActorGoals:
    """The goals that the actor learns for, where they are others than those of values."""

    code: jax.Array
    """float32 [B, d] in the first state."""
    next_code: jax.Array
    """float32 [B, d] in the last state."""


@flax.struct.dataclass
class Waypoints:
    """The states that the episodes of transitions reach some steps later, all without gradient: w_g on the way to the
    actor's goal, no further than this, and w anywhere."""

    low_code: jax.Array
    """float32 [B, d] of what w achieves, in the first state."""
    next_low_code: jax.Array
    """float32 [B, d] of what w achieves, in the last state."""
    code: jax.Array
    """float32 [B, d] of what w_g achieves, in the first state."""
    features: jax.Array
    """float32 [B, F] of w_g."""
    code_there: jax.Array
    """float32 [B, d] of the actor's goal, in w_g."""
    low_weight: jax.Array | None = None
    """float32 [B], 1 where w achieves a known goal, else 0; None: all do."""
    weight: jax.Array | None = None
    """float32 [B], the same of w_g."""


@flax.struct.dataclass
class AgentBatch:
    """B encoded transitions. The gradient of the agent's loss flows through `features` and `code` into the encoders."""

    observation: jax.Array
    """[B, ...] as stored, before the first step."""
    next_observation: jax.Array
    """[B, ...] as stored, after the last step."""
    features: jax.Array
    """float32 [B, F] of the first state."""
    code: jax.Array
    """float32 [B, d] of the desired goal."""
    action: jax.Array
    """int32 [B], or float32 [B, A]."""
    next_features: jax.Array
    """float32 [B, F] of the last state, without gradient."""
    next_code: jax.Array
    """float32 [B, d] of the desired goal in the last state, without gradient."""
    target_features: jax.Array
    """float32 [B, F] of the last state, by the target encoder."""
    target_code: jax.Array
    """float32 [B, d] of the desired goal in the last state, by the target encoder."""
    reward: jax.Array
    """float32 [B], discounted sum over the steps."""
    discount: jax.Array
    """float32 [B], discount of what follows; 0 after termination."""
    action_mask: jax.Array
    """bool [B, A], legal actions in the first state."""
    next_action_mask: jax.Array
    """bool [B, A], legal actions in the last state."""
    largest_value: jax.Array | None = None
    """float32 [], what being at the goal for ever is worth, where an episode goes on at its goal; 1 otherwise."""
    all_goals: AllGoals | None = None
    """The same transitions under all goals, where the agent learns from them, `Agent.all_goals`."""
    first_target_features: jax.Array | None = None
    """float32 [B, F] of the first state, by the target encoder, for an agent that learns from costs; None without."""
    first_target_code: jax.Array | None = None
    """float32 [B, d] of the desired goal in the first state, by the target encoder; None without."""
    at_goal: jax.Array | None = None
    """bool [B], whether the goal was achieved before the first step, for an agent that learns from costs; None
    without."""
    actor: ActorGoals | None = None
    """Goals of the actor, without gradient, where the relabelling draws some (`relabelling/mixed.py`)."""
    waypoints: Waypoints | None = None
    """States on the way to them, where the relabelling draws some."""


def in_bounds(target: jax.Array, batch: AgentBatch) -> jax.Array:
    """Targets [B] between 0 and the largest value that a goal can have, as HER clips them (Andrychowicz et al. 2017,
    Appendix A)."""
    return jnp.clip(target, 0.0, 1.0 if batch.largest_value is None else batch.largest_value)


class Exploration(NamedTuple):
    """How much actions deviate from greedy ones."""

    epsilon: jax.Array | float
    """Probability of a random action, in [0, 1]."""
    noise: jax.Array | float
    """Standard deviation of Gaussian noise on continuous actions. A stochastic policy, as SAC's, is drawn from where
    this is above 0, and acts by its mode at 0."""


def keep(state: Any, rows: Trajectories) -> Any:
    """The state, which new rows do not change."""
    return state


class Agent(NamedTuple):
    """A reinforcement-learning agent. Only `init`, `act`, `value` and `loss` must be given."""

    init: Callable[[jax.Array, jax.Array, jax.Array], tuple[Any, Any]]
    """(key, features [F], code [d]) -> (params, state). The gradient trains the parameters; the state is everything
    else."""
    act: Callable[..., jax.Array]
    """(params, features [B, F], code [B, d], action_mask bool [B, A], key, exploration: Exploration) -> action int32
    [B] or float32 [B, A]."""
    value: Callable[..., jax.Array]
    """(params, features [B, F], code [B, d], action_mask bool [B, A]) -> float32 [B], value of the greedy action."""
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]]
    """(params, target_params, batch: AgentBatch, state, hyper, key) -> (loss, metrics)."""
    num_steps: int = 1
    """Largest number of environment steps of a sampled transition."""
    all_goals: OfAllGoals | None = None
    """Which goals it learns each transition from at once, `AgentBatch.all_goals`; None: from one."""
    observe: Callable[[Any, Trajectories], Any] = keep
    """(state, rows: Trajectories) -> state. Called with each epoch's new rows."""


class OfSteps:
    """A configuration of an agent whose returns span `num_steps` steps."""

    def check(self, config: Any) -> None:
        """Raise `UserError` for returns that span no step, or more than an episode has."""
        longest = config.env.episode_length
        remedy = f"must lie between 1 and the episode length, {longest}"
        require(0 < self.num_steps <= longest, "agent.num_steps", self.num_steps, remedy)
