"""GCB, goal-conditioned bisimulation (Hansen-Estruch, Zhang, Nair, Yin, Levine 2022): pairs of state and goal are
similar if their rewards are.

The distance of two paired codes phi(s, g) is the difference of their rewards plus the distance of the pairs that
follow. A second loss fits psi(g) - psi(s) to phi(s, g); this difference is the goal's code for the policy and says what
is left to do. With sparse rewards most target distances are 0, and the paired codes may collapse: watch the metric
`code_spread`. As in the authors' code, a decoder reads rewards out of the paired codes, which counters the collapse,
and some transitions get a goal achieved later, so that codes are learned for more than the training goals.

Three things differ from the authors' code:

- There the agent also learns from the relabelled transitions. Here it does with `--relabelling her` only, so that
  methods differ in codes alone.
- There the method has its own encoders. Here the state encoder belongs to the agent, and only the agent's loss trains
  it, as with every other method: gradients of the losses below stop at the state's features.
- There phi(g, g) is subtracted from the target of psi, so that nothing is left to do at the goal. Here a goal may be a
  text or an image of an object while a state is a view from the robot. Then a pair (g, g) does not exist, and the
  target of psi is phi(s, g). Where goals are observations, `grounded` subtracts it as there.
"""

import dataclasses
from typing import Annotated, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Share, Sizes, Within
from infogoal_jax.learners.goal_encoder import GoalEncoderConfig
from infogoal_jax.learners.learner import GoalCode, Learner, LearnerBatch, SampleSpec
from infogoal_jax.relabelling import her
from infogoal_jax.rows import take_rows


@dataclasses.dataclass(frozen=True)
class GCBConfig(GoalEncoderConfig):
    """Sizes and switches of GCB."""

    paired_hidden: Sizes = (128, 128)
    """Widths of the layers of phi(s, g) after state and goal are joined, and of psi(s)."""
    reward_weight: Annotated[float, Within("(0, inf)", "give a number greater than 0: 0 makes all pairs alike")] = 1.0
    """Weight c_r of the difference of rewards in the target distance; 1 or 10 in the authors' code."""
    reward_hidden: Count = 512
    """Width of the reward decoder [A]; 0: no decoder."""
    relabelled_share: Share = 0.3
    """Share of the transitions that the losses see with a goal achieved later. The authors add 4 such to every 10."""
    grounded: bool = False
    """Subtract phi(g, g) from the target of psi, as in the authors' code; for tasks whose goals are observations."""
    policy_input: Literal["difference", "goal"] = "difference"
    """Input of the policy. `difference`: psi(g) - psi(s), as in the paper; `goal`: psi(g) alone."""

    def check(self, config) -> None:
        """Raise `UserError` for batches of one transition."""
        remedy = "learner gcb compares transitions of a batch; give 2 or more"
        require(config.batch_size > 1, "batch_size", config.batch_size, remedy)


class PairedEncoder(nn.Module):
    """phi(s, g): features of states [..., B, F] and goal inputs [B, ...] to [..., B, out].

    A linear layer brings the features to the size of the goal's code, so that neither dominates.
    """

    hidden: tuple[int, ...]
    paired_hidden: tuple[int, ...]
    out: int
    standardise: bool

    @nn.compact
    def __call__(self, features, goal_inputs):
        goal = networks.GoalLayers(self.hidden, self.out, self.standardise)(goal_inputs)
        state = networks.last_layer(self.out)(features)
        return networks.MLP(self.paired_hidden, self.out)(
            jnp.concatenate([state, jnp.broadcast_to(goal, state.shape)], axis=-1)
        )


class RewardDecoder(nn.Module):
    """The reward [B] of a transition from its two paired codes, [B, d] each."""

    hidden: int

    @nn.compact
    def __call__(self, codes, next_codes):
        joined = networks.normalised(networks.last_layer(self.hidden)(jnp.concatenate([codes, next_codes], axis=-1)))
        return networks.last_layer(1)(nn.relu(joined))[..., 0]


def bisimulation_target(
    rewards: jax.Array, following: jax.Array, discounts: jax.Array, partner: jax.Array, reward_weight: float
) -> jax.Array:
    """Target distance of paired codes (Hansen-Estruch et al., the goal-conditioned bisimulation metric), [B], without
    gradient.

    c_r h(r_i - r_j) + || discount_i phi'_i - discount_j phi'_j ||_2, where h is the Huber loss (smooth L1) and phi' =
    phi(s', g) [B, d].
    partner: int32 [B], j for each i. For equal discounts this is the authors' gamma || phi'_i - phi'_j ||. A terminated
    transition has discount 0 and no successor. Two of them differ by their rewards alone; one of them and a transition
    that continues differ by discount || phi' || too.
    """
    rewards, following = jax.lax.stop_gradient((rewards, discounts[:, None] * following))
    gap = networks.squared_or_huber(rewards, rewards[partner], huber=True)
    return reward_weight * gap + jnp.linalg.norm(following - following[partner], axis=-1)


def paired_loss(codes: jax.Array, target: jax.Array, partner: jax.Array) -> jax.Array:
    """L_phi = mean_i (|| phi_i - phi_j ||_1 - target_i)^2 for paired codes [B, d]. The norm sums over d, so distances
    grow with d."""
    gap = codes - take_rows(codes, partner)
    # The slope of jnp.abs at 0 is 1, which would push equal codes apart in one direction.
    distance = (gap * jnp.sign(gap)).sum(-1)
    return ((distance - target) ** 2).mean()


def difference_loss(difference: jax.Array, paired: jax.Array, grounding: jax.Array | float = 0.0) -> jax.Array:
    """L_psi = mean over pairs and d of (psi(g) - psi(s) - sg[phi(s, g) - grounding])^2; the authors' grounding is
    phi(g, g)."""
    return ((difference - jax.lax.stop_gradient(paired - grounding)) ** 2).mean()


def code_spread(codes: jax.Array) -> jax.Array:
    """Standard deviation of codes [B, d] over their 1-norm, times sqrt(d) (authors' code): 0 if all are equal, 1.25 /
    sqrt(d) for Gaussian noise."""
    size = jnp.abs(codes).sum(-1, keepdims=True)
    return jnp.sqrt(codes.shape[-1]) * (codes / jnp.maximum(size, 1e-12)).std(0, ddof=1).mean()


def make(config: GCBConfig) -> Learner:
    encoder = networks.GoalLayers(config.hidden, config.latent_size, config.standardise_images)
    state_head = networks.MLP(config.paired_hidden, config.latent_size)
    paired = PairedEncoder(config.hidden, config.paired_hidden, config.latent_size, config.standardise_images)
    decoder = RewardDecoder(config.reward_hidden)

    def init(key, example, hyper):
        keys = jax.random.split(key, 4)
        goal_inputs, features = example.goal_inputs[:1], example.features[None]
        params = {
            "encoder": encoder.init(keys[0], goal_inputs),
            "state_head": state_head.init(keys[1], features),
            "paired": paired.init(keys[2], features, goal_inputs),
        }
        if config.reward_hidden:
            code = jnp.zeros((1, config.latent_size), jnp.float32)
            params["reward_decoder"] = decoder.init(keys[3], code, code)
        return params, ()

    def encode(params, goal_inputs):
        """psi(g)."""
        return GoalCode(encoder.apply(params["encoder"], goal_inputs))

    def condition(params, code, features):
        """psi(g) - psi(s)."""
        return GoalCode(code.mean - state_head.apply(params["state_head"], features))

    def loss(params, state, batch: LearnerBatch, hyper, key):
        """L_phi of each n-step transition with another of the batch, plus L_psi, plus the squared error of the reward
        decoder."""
        transitions = batch.transitions
        features, following = jax.lax.stop_gradient((transitions.features, transitions.next_features))
        at_goal = [batch.features_of(batch.desired_goal)] if config.grounded else []
        codes, next_codes, *grounding = paired.apply(
            params["paired"], jnp.stack([features, following, *at_goal]), batch.inputs_of(batch.desired_goal)
        )
        partner = jax.random.permutation(key, len(codes))
        target = bisimulation_target(
            transitions.reward, next_codes, transitions.discount, partner, config.reward_weight
        )
        paired_error = paired_loss(codes, target, partner)
        psi_error = difference_loss(
            condition(params, batch.encode(batch.desired_goal), features).mean, codes, *grounding
        )
        metrics = {
            "paired_loss": paired_error,
            "psi_loss": psi_error,
            "target": target.mean(),
            "code_spread": code_spread(codes),
        }
        total = paired_error + psi_error
        if config.reward_hidden:
            decoded = decoder.apply(params["reward_decoder"], codes, next_codes)
            metrics["reward_error"] = ((decoded - jax.lax.stop_gradient(transitions.reward)) ** 2).mean()
            total += metrics["reward_error"]
        return total, metrics, state

    condition_on = condition if config.policy_input == "difference" else None
    share = config.relabelled_share
    relabelling = her.make(her.HERConfig(future_share=share)) if share else None
    return Learner(
        init,
        encode,
        loss,
        SampleSpec(relabelling=relabelling),
        condition=condition_on,
        needs_features_of_goals=config.grounded,
    )
