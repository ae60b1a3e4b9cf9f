"""DQN with a universal value function Q(s, g, a): double Q-learning, target network, n-step returns and action
masks."""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import value_heads
from infogoal_jax.agents.agent import Agent, AgentBatch, AgentTraits, OfSteps
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.field_types import Size, Sizes


@dataclasses.dataclass(frozen=True)
class DQNConfig(OfAllGoals, OfSteps):
    """Sizes and switches of DQN."""

    hidden: Sizes = (256, 256)
    """Widths of the value head's layers [M]; the authors' 128 128 learns more slowly."""
    num_steps: int = 8
    """Steps of the n-step return [M]; the authors' 3 learns more slowly."""
    huber: bool = True
    """Huber loss with threshold 1 instead of the squared error."""
    head: value_heads.Kind = "concatenated"
    """How values depend on the goal: `concatenated`: one network of features and code; `product`: the all-goals head;
    `index`: LEO (docs/research/all_goals.md)."""
    head_size: Size = 128
    """Size of the vectors whose product is a value, for `product` alone."""
    layer_norm: bool = False
    """Normalise what each ReLU of the head gets, as LEO's authors do (docs/research/all_goals.md)."""
    bounded: bool = False
    """Keep values between 0 and 1 by a sigmoid. Not for rewards other than 1 at the goal."""

    def check(self, config) -> None:
        """Raise `UserError` for returns of no step or too many, and for shares of goals that are more than all."""
        super().check(config)
        self.check_all_goals()


def traits(config: DQNConfig) -> AgentTraits:
    """It chooses among moves."""
    return AgentTraits("moves", all_goals=config.all_goals, sigmoid=config.bounded)


def greedy(values: jax.Array, action_mask: jax.Array) -> jax.Array:
    """The legal action with the highest value, int32 [...]: values float32 [..., A], action_mask bool [..., A]."""
    return jnp.where(action_mask, values, -jnp.inf).argmax(-1)


def double_q_target(reward, discount, next_values, target_values, next_action_mask) -> jax.Array:
    """Targets of double Q-learning (van Hasselt et al. 2016, Eq. 4), float32 [B], without gradient: the trained network
    chooses what follows, the target network says what it is worth.

    reward, discount: float32 [B], of the transition and of what follows it; next_values, target_values: float32 [B, A]
    after the transition, by the trained and by the target network; next_action_mask: bool [B, A].
    """
    chosen = greedy(next_values, next_action_mask)
    return jax.lax.stop_gradient(reward + discount * value_heads.of_actions(target_values, chosen))


def td_loss(
    values: jax.Array, actions: jax.Array, target: jax.Array, huber: bool
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Temporal-difference error of the values float32 [B, A] of these actions int32 [B] against their targets float32
    [B]: (loss, metrics)."""
    predicted = value_heads.of_actions(values, actions)
    error = networks.squared_or_huber(predicted, target, huber)
    return error.mean(), {"td_error": jnp.abs(predicted - target).mean(), "value": predicted.mean()}


def make(config: DQNConfig, env) -> Agent:
    return value_agent(config, env)


def value_agent(config: DQNConfig, env, regulariser=None) -> Agent:
    """An agent that learns action values by double Q-learning and acts epsilon-greedily.

    regulariser(values float32 [B, A], batch, hyper) -> (loss, metrics), or None, is added to the temporal-difference
    error.
    """
    num_goals = env.goals.num_goals if config.head == "index" else 0
    head = value_heads.make(
        config.head, config.hidden, config.head_size, config.layer_norm, config.bounded, env.action_size, num_goals
    )
    values = head.values

    def init(key, features, code):
        return head.init(key, features, code), ()

    def act(params, features, code, action_mask, key, exploration):
        """Epsilon-greedy among the legal actions."""
        choose, pick = jax.random.split(key)
        best = greedy(values(params, features, code), action_mask)
        random = jnp.where(action_mask, jax.random.uniform(pick, action_mask.shape, jnp.float32), -1.0).argmax(-1)
        return jnp.where(
            jax.random.uniform(choose, best.shape, jnp.float32) < exploration.epsilon, random, best
        ).astype(jnp.int32)

    def value(params, features, code, action_mask):
        """The value of the greedy action."""
        return jnp.where(action_mask, values(params, features, code), -jnp.inf).max(-1)

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """Temporal-difference error of double Q-learning, and the regulariser; or that of all goals at once."""
        if batch.all_goals is not None:
            return value_heads.value_loss(head, config.huber, regulariser, params, target_params, batch, hyper)
        next_values = values(params, batch.next_features, batch.next_code)
        target_values = values(target_params, batch.target_features, batch.target_code)
        target = double_q_target(batch.reward, batch.discount, next_values, target_values, batch.next_action_mask)
        every = values(params, batch.features, batch.code)
        error, metrics = td_loss(every, batch.action, target, config.huber)
        if regulariser is None:
            return error, metrics
        extra, own_metrics = regulariser(every, batch, hyper)
        return error + extra, metrics | own_metrics

    return Agent(init, act, value, loss, config.num_steps, config.goals_at_once())
