"""SSE-DB, self-supervised exploration by a dynamic bottleneck (Bai et al., NeurIPS 2021).

A move (s, a) is encoded as a Gaussian code z, which has to predict the next state and is compressed towards N(0, I).
The KL of the code in nats is the bonus for the move. The loss also trains the state encoder, which the explorer shares
with the agent.
"""

import dataclasses

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.exploration.explorer import Explorer, Moves
from infogoal_jax.field_types import Size, Weight
from infogoal_jax.learners.goal_encoder import kl_to_standard_normal, weighted_mean
from infogoal_jax.learners.learner import GoalCode
from infogoal_jax.replay import Trajectories
from infogoal_jax.shapes import with_rank

NUM_BLOCKS = 2
# Standard deviation of predictions: without it exact ones would make the likelihood unbounded. It is added, where the
# authors clip, so that a gradient is left at the floor.
MINIMUM_SCALE = 0.1
MINIMUM_RETURN = (
    1e-3  # Standard deviation of the bonus's returns, in nats. Below it the bonus no longer tells moves apart.
)


@dataclasses.dataclass(frozen=True)
class SSEDBConfig:
    """Sizes and weights of the dynamic bottleneck. Sizes are about a quarter of the original's, for images of a quarter
    of the side."""

    latent_size: Size = 32
    """Size of the code z of a move; the original has 128."""
    width: Size = 128
    """Width of all layers; the original has 256."""
    projection_size: Size = 64
    """Size of the projections for InfoNCE; the original has 128."""
    kl_weight: Weight = 0.001
    """alpha 1: weight of the KL of the code to N(0, I). The authors have 0.1, and 0.001 for some games. With 0.1 the
    shared state encoder collapses here [M]. 0 or more."""
    prediction_weight: Weight = 0.1
    """alpha 2: weight of the log-likelihood of the next state's features. 0 or more."""
    contrastive_weight: Weight = 0.1
    """alpha 3: weight of InfoNCE, which tells the next state apart from others. 0 or more."""
    square_root: bool = False
    """Take the square root of the bonus, as the paper has it; the authors' code does not."""


@flax.struct.dataclass
class SSEDBState:
    """What is not trained by the gradient."""

    scale: jax.Array
    """float32 [], standard deviation of the discounted returns of the last bonus, in nats; 0 before the first."""
    actions: jax.Array
    """float32 [A, A], the one-hot actions."""


class MoveLayer(nn.Module):
    """A linear layer of a vector [..., D] concatenated with a one-hot action [..., A]."""

    width: int

    @nn.compact
    def __call__(self, inputs, action):
        seen, moved = networks.last_layer(self.width)(inputs), networks.last_layer(self.width, use_bias=False)(action)
        return seen + with_rank(moved, seen.ndim)


class Transition(nn.Module):
    """g(z|s, a): features [..., F] and one-hot actions [..., A] to mean and std of the code [..., latent_size]. Every
    layer sees the action."""

    width: int
    latent_size: int

    @nn.compact
    def __call__(self, features, action):
        hidden = nn.leaky_relu(MoveLayer(self.width)(features, action))
        for _ in range(NUM_BLOCKS):
            step = nn.leaky_relu(MoveLayer(self.width)(hidden, action))
            hidden = hidden + MoveLayer(self.width)(step, action)
        mean, raw = jnp.split(MoveLayer(2 * self.latent_size)(hidden, action), 2, axis=-1)
        return mean, jax.nn.softplus(raw) + networks.MINIMUM_STD


class Projection(nn.Module):
    """Features [..., F] to projections [..., out] for InfoNCE."""

    width: int
    out: int

    @nn.compact
    def __call__(self, features):
        return nn.LayerNorm()(
            networks.last_layer(self.out)(nn.relu(nn.LayerNorm()(networks.last_layer(self.width)(features))))
        )


def contrast(score: jax.Array, predicted: jax.Array, followed: jax.Array) -> jax.Array:
    """log softmax [B, B] of the bilinear scores u W v / sqrt(d) of predictions [B, d] and next states [B, d]. The true
    pairs are on the diagonal."""
    return jax.nn.log_softmax(predicted @ score @ followed.T / jnp.sqrt(predicted.shape[-1]), axis=-1)


def discounted_returns(reward: jax.Array, valid: jax.Array, discount: jax.Array | float) -> jax.Array:
    """Discounted return of each step within its episode, float32 [R, T], from rewards [R, T]; 0 where the transition is
    not valid [R, T]."""

    def back(following, now):
        reward, valid = now
        total = jnp.where(valid, reward + discount * following, 0.0)
        return total, total

    return jax.lax.scan(back, jnp.zeros(len(reward), jnp.float32), (reward.T, valid.T), reverse=True)[1].T


def make(config: SSEDBConfig) -> Explorer:
    transition = Transition(config.width, config.latent_size)
    projection = Projection(config.width, config.projection_size)

    def decoder(size: int) -> networks.MLP:
        return networks.MLP((config.width, config.width), size)

    def init(key, features, num_actions):
        keys = jax.random.split(key, 3)
        params = {
            "transition": transition.init(keys[0], features, jnp.zeros(num_actions, jnp.float32)),
            "decoder": decoder(features.shape[-1]).init(keys[1], jnp.zeros(config.latent_size, jnp.float32)),
            "log_scale": jnp.zeros((), jnp.float32),
            "projection": projection.init(keys[2], features),
            "score": jnp.eye(config.projection_size, dtype=jnp.float32),  # The authors': uniform in 0 to 1.
        }
        return params, SSEDBState(jnp.zeros((), jnp.float32), jnp.eye(num_actions, dtype=jnp.float32))

    def code_of(params, features, action):
        return GoalCode(*transition.apply(params["transition"], features, action))

    def compute_bonus(params, state, features, rows: Trajectories, written, discount):
        """Bonus KL(g(z|s, a) || N(0, I)) of every move, divided by the standard deviation of its discounted returns in
        the replay buffer."""
        bonus = kl_to_standard_normal(code_of(params, features[:, None], state.actions))
        bonus = jnp.sqrt(jnp.maximum(bonus, 0.0)) if config.square_root else bonus
        counted = rows.valid & written[:, None]
        returns = discounted_returns(bonus[rows.observation[:, :-1], rows.action], counted, discount)
        deviation = jnp.sqrt(weighted_mean((returns - weighted_mean(returns, counted)) ** 2, counted))
        return bonus / jnp.maximum(deviation, MINIMUM_RETURN), state.replace(scale=deviation)

    def loss(params, state, moves: Moves, key):
        """The dynamic bottleneck (Bai et al. 2021): alpha 1 KL - alpha 2 log q(s'|z) - alpha 3 InfoNCE, where InfoNCE
        is a log softmax."""
        code_key, prediction_key = jax.random.split(key)
        following = jax.lax.stop_gradient(moves.next_features)
        code = code_of(params, moves.features, state.actions[moves.action])
        mean = decoder(following.shape[-1]).apply(params["decoder"], code.sample(code_key))
        scale = MINIMUM_SCALE + jnp.exp(params["log_scale"])
        # Per feature: of the order of 1.
        surprise = (0.5 * ((following - mean) / scale) ** 2 + jnp.log(scale) + 0.5 * jnp.log(2 * jnp.pi)).mean(-1)
        drawn = GoalCode(mean, scale).sample(prediction_key)
        followed = projection.apply(jax.lax.stop_gradient(params["projection"]), following)
        chances = contrast(params["score"], projection.apply(params["projection"], drawn), followed)
        metrics = {
            "kl": kl_to_standard_normal(code).mean(),
            "prediction_loss": surprise.mean(),
            "contrastive_loss": -jnp.diagonal(chances).mean(),
            # Where several moves of the batch lead to one state, any of them is correct.
            "accuracy": (following[chances.argmax(-1)] == following).all(-1).mean(),
        }
        weights = {
            "kl": config.kl_weight,
            "prediction_loss": config.prediction_weight,
            "contrastive_loss": config.contrastive_weight,
        }
        return sum(weight * metrics[name] for name, weight in weights.items()), metrics, state

    return Explorer(init, compute_bonus, loss)
