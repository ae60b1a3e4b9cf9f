"""Pairs of goals where G_neg of a finite set does not say which are similar: in a continuous space, and by the true
distance of a learner's radius."""

import jax
import jax.numpy as jnp

from infogoal_jax import pairs as goal_pairs
from infogoal_jax import replay
from infogoal_jax.goals import is_goal, with_placeholders
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.parts import Setup


def sample_pairs_by_distance(setup: Setup, experience: Experience, key: jax.Array) -> GoalPairs:
    """Goal pairs as `sample_pairs`, of which the learner's radius says whether they are similar (the authors' code). A
    goal is paired with itself where 16 candidates for its positive were rejected."""
    spec, goals = setup.parts.learner.sample_spec, setup.env.goals
    mask = goals.listed_mask & goals.usable_mask(setup.config.known_goals) if spec.listed else experience.known.mask
    known, keys = goal_pairs.KnownGoals(mask), jax.random.split(key, 4)
    anchor = known.draw(keys[0], (spec.num_pairs,))
    positive, found = goal_pairs.sample_negatives(keys[1], ~experience.dissimilarity, mask, anchor)
    weight = jnp.broadcast_to(known.any(), anchor.shape).astype(jnp.float32)
    shape = (spec.num_pairs, spec.num_negatives)
    contrast = jnp.broadcast_to(anchor[:, None], shape) if spec.anchored else known.draw(keys[2], shape)
    negative, negative_weight = goal_pairs.sample_negatives(keys[3], experience.dissimilarity, mask, contrast)
    return GoalPairs(anchor, jnp.where(found > 0, positive, anchor), contrast, negative, weight, negative_weight)


def sample_apart(
    setup: Setup, experience: Experience, key: jax.Array, place: tuple[jax.Array, jax.Array], contrast: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Draw for each goal of a continuous space one from the buffer that is dissimilar to it (line 20), by rejection.

    place: row and step, int32 [B, 1] or [B, K], where the goals contrast [B, K, D] were achieved. Returns goals [B, K,
    D] and weights float32 [B, K], 0 where every candidate was rejected.
    """
    parts, _, env = setup
    goals, spec = experience.known.goals, parts.learner.sample_spec
    place_key, goal_key = jax.random.split(key)
    tried = (*contrast.shape[:-1], goal_pairs.REJECTION_TRIES)
    there = replay.draw(place_key, experience.achieved_count, tried, goals.shape[1])
    candidates = goal_pairs.choose_goal(goal_key, goals[there])
    if spec.dissimilar_by == "cells":
        dissimilar = experience.dissimilarity[env.goals.cell_of(contrast)[..., None], env.goals.cell_of(candidates)]
    elif spec.dissimilar_by == "classifier":
        every = jnp.broadcast_to(contrast[..., None, :], candidates.shape)
        seen = env.goals.inputs_of(every), env.goals.inputs_of(with_placeholders(candidates))
        dissimilar = ~parts.learner.similar(experience.goal_params, *seen)
    else:
        dissimilar = achieved_apart(setup, experience, place, there, contrast, candidates)
    accepted = dissimilar & is_goal(candidates) & (experience.achieved_count[-1] > 0)
    first = accepted.argmax(-1)[..., None]
    negative = jnp.take_along_axis(candidates, first[..., None], axis=-2)[..., 0, :]
    return negative, accepted.any(-1).astype(jnp.float32)


def achieved_apart(
    setup: Setup,
    experience: Experience,
    place: tuple[jax.Array, jax.Array],
    there: tuple[jax.Array, jax.Array],
    contrast: jax.Array,
    candidates: jax.Array,
) -> jax.Array:
    """Whether goals [B, K, D] and their candidates [B, K, tries, D], achieved at these rows and steps, were not
    achieved within the window in one trajectory, and none achieves the other: bool [B, K, tries]."""
    env, window = setup.env, setup.parts.learner.sample_spec.window
    buffer, tried = experience.buffer, candidates.shape[:-1]
    here = tuple(jnp.broadcast_to(index[..., None], tried) for index in place)
    record, other = (jax.tree.map(lambda leaf, at=at: leaf[at], buffer.record) for at in (here, there))
    episode = experience.episode
    apart = (here[0] != there[0]) | (episode[here] != episode[there]) | (jnp.abs(here[1] - there[1]) > window)
    one_achieves_other = env.reached(other, contrast[..., None, :]) | env.reached(record, candidates)
    return apart & ~one_achieves_other
