"""GCB, goal-conditioned bisimulation (Hansen-Estruch, Zhang, Nair, Yin, Levine 2022): pairs of state and goal are alike if they pay alike.

A paired code phi(s, g) is as far from another as their rewards differ, plus as far as the pairs that follow lie apart. It is then split in two,
psi(g) - psi(s), and that difference is the goal's code for the policy: what is left to do. Where rewards are sparse most target distances are 0, and
the paired codes may collapse into one: watch the metric `code_spread`. As in the authors' code, a decoder that reads rewards out of the paired codes
keeps what tells them apart, and some transitions are seen under a goal achieved later, so that codes are learned for more goals than are commanded.

Three things differ from the authors' code. There the agent learns from the transitions under later goals too; here it does if `--relabelling her`
asks for that, and methods are compared by what they make of goals. There the encoders of this method are its own; here the state encoder belongs to
the agent, whose loss alone trains it, as it does with every other method: gradients of the losses below stop at the state's features. And the authors
take phi(g, g) from the target of psi, so that nothing is left to do at the goal; here a goal may be a text or a picture of an object while a state is
a view from the robot: there is no pair (g, g), and the target of psi is phi(s, g) itself.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from infogoal_jax import networks
from infogoal_jax.errors import require
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig
from infogoal_jax.learners.learner import GoalCode, Learner, LearnerBatch, SampleSpec


@dataclasses.dataclass(frozen=True)
class GCBConfig(GoalEncoderConfig):
    """Sizes and switches of GCB; the goal encoder's are those of every method."""

    paired_hidden: tuple[int, ...] = (128, 128)
    """Widths of the layers that join state and goal to the paired code, and of those of psi(s)."""
    reward_weight: float = 1.0
    """Weight c_r of the gap between rewards in the target distance; 1 or 10 in the authors' code."""
    reward_hidden: int = 512
    """Width of the decoder of rewards [authors' code]; 0: none."""
    relabelled_share: float = 0.3
    """Share of the transitions that the losses see under a goal achieved later; the authors add 4 such to every 10."""
    policy_input: Literal["difference", "goal"] = "difference"
    """What the policy is given: `difference`: psi(g) - psi(s), as in the paper; `goal`: psi(g) alone."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        super().check(config)
        require(all(width > 0 for width in self.paired_hidden), "learner.paired_hidden", self.paired_hidden,
                "give widths greater than 0, for example 128 128")
        require(self.reward_hidden >= 0, "learner.reward_hidden", self.reward_hidden, "give a width, or 0 for no decoder")
        require(0 <= self.relabelled_share <= 1, "learner.relabelled_share", self.relabelled_share, "give a share from 0 to 1")
        require(self.reward_weight > 0, "learner.reward_weight", self.reward_weight, "give a number greater than 0: 0 makes all pairs alike")
        require(self.policy_input in ("difference", "goal"), "learner.policy_input", self.policy_input, "give difference or goal")


class PairedEncoder(nn.Module):
    """phi(s, g): features [..., B, F] of states and inputs of goals [B, ...] to [..., B, out].

    A linear layer brings the features to the size of the goal's code, so that neither outweighs the other where the two are joined.
    """

    hidden: tuple[int, ...]
    paired_hidden: tuple[int, ...]
    out: int
    standardise: bool

    @nn.compact
    def __call__(self, features, goal_inputs):
        goal = networks.GoalLayers(self.hidden, self.out, self.standardise)(goal_inputs)
        state = nn.Dense(self.out)(features)
        return networks.MLP(self.paired_hidden, self.out)(jnp.concatenate([state, jnp.broadcast_to(goal, state.shape)], axis=-1))


class RewardDecoder(nn.Module):
    """The reward of a transition, [B], out of its two paired codes [B, d] each."""

    hidden: int

    @nn.compact
    def __call__(self, codes, next_codes):
        joined = nn.LayerNorm()(nn.Dense(self.hidden)(jnp.concatenate([codes, next_codes], axis=-1)))
        return nn.Dense(1)(nn.relu(joined))[..., 0]


def bisimulation_target(rewards: jax.Array, following: jax.Array, discounts: jax.Array, partner: jax.Array, reward_weight: float) -> jax.Array:
    """How far apart paired codes should lie (Hansen-Estruch et al., the goal-conditioned bisimulation metric), [B], without gradient.

    c_r h(r_i - r_j) + || discount_i phi'_i - discount_j phi'_j ||_2, where h is the Huber loss (smooth L1) and phi' = phi(s', g) [B, d].
    partner: int32 [B], j for each i. For equal discounts this is the authors' gamma || phi'_i - phi'_j ||. A transition that terminated has
    discount 0 and no successor: two of them differ by their rewards alone, and one of them lies discount || phi' || from another that goes on.
    """
    rewards, following = jax.lax.stop_gradient((rewards, discounts[:, None] * following))
    gap = optax.huber_loss(rewards, rewards[partner])
    return reward_weight * gap + jnp.linalg.norm(following - following[partner], axis=-1)


def paired_loss(codes: jax.Array, target: jax.Array, partner: jax.Array) -> jax.Array:
    """L_phi = mean_i (|| phi_i - phi_j ||_1 - target_i)^2 for paired codes [B, d]; the norm sums over d, so that distances grow with d."""
    gap = codes - codes[partner]
    distance = (gap * jnp.sign(gap)).sum(-1)  # The slope of jnp.abs at 0 is 1, which would drive equal codes apart in one direction.
    return ((distance - target) ** 2).mean()


def difference_loss(difference: jax.Array, paired: jax.Array, grounding: jax.Array | float = 0.0) -> jax.Array:
    """L_psi = mean over pairs and d of (psi(g) - psi(s) - sg[phi(s, g) - grounding])^2; the authors' grounding is phi(g, g)."""
    return ((difference - jax.lax.stop_gradient(paired - grounding)) ** 2).mean()


def code_spread(codes: jax.Array) -> jax.Array:
    """Standard deviation of codes [B, d] over their 1-norm, times sqrt(d) (authors' code): 0 if all are one, 1.25 / sqrt(d) for Gaussian noise."""
    size = jnp.abs(codes).sum(-1, keepdims=True)
    return jnp.sqrt(codes.shape[-1]) * (codes / jnp.maximum(size, 1e-12)).std(0, ddof=1).mean()


def make(config: GCBConfig) -> Learner:
    """The GCB learner for this configuration."""
    encoder = networks.GoalLayers(config.hidden, config.latent_size, config.standardise_images)
    state_head = networks.MLP(config.paired_hidden, config.latent_size)
    paired = PairedEncoder(config.hidden, config.paired_hidden, config.latent_size, config.standardise_images)
    decoder = RewardDecoder(config.reward_hidden)

    def init(key, example, hyper):
        keys = jax.random.split(key, 4)
        goal_inputs, features = example.goal_inputs[:1], example.features[None]
        params = {
            "encoder": encoder.init(keys[0], goal_inputs), "state_head": state_head.init(keys[1], features),
            "paired": paired.init(keys[2], features, goal_inputs),
        }
        if config.reward_hidden:
            code = jnp.zeros((1, config.latent_size))
            params["reward_decoder"] = decoder.init(keys[3], code, code)
        return params, ()

    def encode(params, goal_inputs):
        """psi(g)."""
        return GoalCode(encoder.apply(params["encoder"], goal_inputs))

    def condition(params, code, features):
        """psi(g) - psi(s)."""
        return GoalCode(code.mean - state_head.apply(params["state_head"], features))

    def loss(params, state, batch: LearnerBatch, hyper, key):
        """L_phi of each transition, of n steps as the agent's are, with another of the batch, plus L_psi, plus the decoder's square error."""
        transitions = batch.transitions
        features, following = jax.lax.stop_gradient((transitions.features, transitions.next_features))
        codes, next_codes = paired.apply(params["paired"], jnp.stack([features, following]), batch.inputs_of(batch.desired))
        partner = jax.random.permutation(key, len(codes))
        target = bisimulation_target(transitions.reward, next_codes, transitions.discount, partner, config.reward_weight)
        paired_error = paired_loss(codes, target, partner)
        psi_error = difference_loss(condition(params, batch.encode(batch.desired), features).mean, codes)
        metrics = {"paired_loss": paired_error, "psi_loss": psi_error, "target": target.mean(), "code_spread": code_spread(codes)}
        total = paired_error + psi_error
        if config.reward_hidden:
            decoded = decoder.apply(params["reward_decoder"], codes, next_codes)
            metrics["reward_error"] = ((decoded - jax.lax.stop_gradient(transitions.reward)) ** 2).mean()
            total += metrics["reward_error"]
        return total, metrics, state

    condition_on = condition if config.policy_input == "difference" else None
    return Learner(init, encode, loss, SampleSpec(relabelled_share=config.relabelled_share), condition=condition_on)
