"""DGRL: codes are discrete and stay in use, gradients go where they should, and goals are reconstructed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made_codes import SMALL, VECTORS, begun, constant_error, loss_of, trained

from infogoal_jax import networks
from infogoal_jax.learners import dgrl

DISCRETE = dgrl.DGRLConfig(factors=4, codes=16, **SMALL)


@pytest.fixture(scope="module")
def discrete():
    """A DGRL learner with parameters and state as they begin, but for a codebook unlike any segment, so that replacing
    a segment changes it."""
    learner = dgrl.make(DISCRETE)
    params, state = begun(learner, VECTORS)
    return (
        learner,
        params
        | {"codebook": params["codebook"] + 0.1 * jax.random.normal(jax.random.key(1), params["codebook"].shape)},
        state,
    )


def test_codebook_starts_among_the_segments_of_goals():
    params, _ = begun(dgrl.make(DISCRETE), VECTORS)
    segments = dgrl.segments_of(DISCRETE, params["encoder"], VECTORS).reshape(-1, 2)
    distance = jnp.linalg.norm(params["codebook"][:, None] - segments, axis=-1).min(1)
    assert (distance < 0.1 * segments.std()).all()
    assert len(np.unique(params["codebook"], axis=0)) == DISCRETE.codes


def test_each_segment_is_replaced_by_the_nearest_code_vector(discrete):
    learner, params, _ = discrete
    segments = np.asarray(dgrl.segments_of(DISCRETE, params["encoder"], VECTORS))
    codes = np.asarray(learner.encode(params, VECTORS).mean).reshape(segments.shape)
    indices = np.asarray(dgrl.indices_of(DISCRETE, params, VECTORS))
    codebook = np.asarray(params["codebook"])
    for goal, factor in np.ndindex(*indices.shape):
        best = min(range(DISCRETE.codes), key=lambda code: np.linalg.norm(segments[goal, factor] - codebook[code]))
        assert indices[goal, factor] == best
        np.testing.assert_array_equal(codes[goal, factor], codebook[best])
    assert len(np.unique(indices)) > 2 and not np.allclose(codes, segments, atol=0.01)


def test_many_goals_share_few_codes(discrete):
    """As many as the codebook allows: 3 vectors in 4 places make 81 at most, whatever the goals."""
    learner, params, _ = discrete
    goals = jax.random.normal(jax.random.key(2), (2000, 16))
    params = params | {"codebook": params["codebook"][:3]}
    distinct = np.unique(learner.encode(params, goals).mean, axis=0)
    assert 3 < len(distinct) <= 81
    assert len(distinct) == len(np.unique(dgrl.indices_of(DISCRETE, params, goals), axis=0))


def test_the_agents_gradient_passes_the_replacement_and_never_reaches_the_codebook(discrete):
    learner, params, _ = discrete
    weights = jax.random.normal(jax.random.key(3), (len(VECTORS), 8))
    segments, vectors = jax.random.normal(jax.random.key(4), (2, 5, 2))
    np.testing.assert_array_equal(
        jax.grad(lambda y: (weights[:5, :2] * dgrl.straight_through(y, vectors)).sum())(segments), weights[:5, :2]
    )

    gradient = jax.grad(lambda params: (weights * learner.encode(params, VECTORS).mean).sum())(params)
    assert not gradient["codebook"].any()
    plain = networks.GoalLayers(DISCRETE.hidden, DISCRETE.latent_size)
    identity = jax.grad(lambda encoder: (weights * plain.apply(encoder, VECTORS)).sum())(params["encoder"])
    jax.tree.map(
        lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6), gradient["encoder"], identity
    )
    assert any(leaf.any() for leaf in jax.tree.leaves(identity))


def test_each_distance_trains_its_own_side(discrete):
    """Of the whole loss, the codebook feels |sg[y] - e|^2 alone as long as no code vector is lost."""
    learner, params, state = discrete
    segments = dgrl.segments_of(DISCRETE, params["encoder"], VECTORS)
    indices = dgrl.nearest(segments, params["codebook"])

    def distances(segments, codebook):
        return jnp.stack(dgrl.distances_to_codes(segments, codebook[indices]))

    to_segments, to_codebook = jax.jit(jax.jacobian(distances, argnums=(0, 1)))(segments, params["codebook"])
    assert not to_segments[0].any() and to_segments[1].any() and to_codebook[0].any() and not to_codebook[1].any()
    whole = jax.jit(jax.grad(lambda params: loss_of(learner, VECTORS, params, state, jax.random.key(0)), has_aux=True))(
        params
    )[0]
    np.testing.assert_allclose(whole["codebook"], to_codebook[0], atol=1e-6)


def test_only_code_vectors_that_were_idle_for_long_are_revived(discrete):
    _, params, state = discrete
    state = state.replace(idle=jnp.full(DISCRETE.codes, dgrl.PATIENCE - 1).at[3].set(dgrl.PATIENCE))
    segments = dgrl.segments_of(DISCRETE, params["encoder"], VECTORS).reshape(-1, 2)
    indices = dgrl.nearest(segments, params["codebook"])
    to_codebook, to_segments = jax.grad(dgrl.revival_loss, argnums=(0, 1))(params["codebook"], segments, indices, state)
    assert to_codebook[3].any() and not jnp.delete(to_codebook, 3, axis=0).any() and not to_segments.any()
    moved = params["codebook"][3] - DISCRETE.codes / 2 * to_codebook[3]  # To where the pull would end.
    assert jnp.linalg.norm(segments - moved, axis=1).min() < 1e-5


def test_use_is_counted():
    state = dgrl.DGRLState(jnp.zeros(3), jnp.array([0, 5, 7]), jnp.zeros((3, 2)))
    state, _ = jax.lax.scan(
        lambda state, _: (dgrl.after_use(state, jnp.array([[0, 0], [0, 2]])), None), state, length=1000
    )
    np.testing.assert_array_equal(state.idle, [0, 1005, 0])
    np.testing.assert_allclose(state.usage, [0.75, 0, 0.25], atol=1e-3)
    np.testing.assert_allclose(
        dgrl.perplexity(state.usage), np.exp(-0.75 * np.log(0.75) - 0.25 * np.log(0.25)), rtol=1e-3
    )
    assert dgrl.perplexity(jnp.full(8, 0.01)) == pytest.approx(8, rel=1e-4)


def test_lost_code_vectors_come_back():
    """All code vectors but one begin far from every segment, and the segments stay where they are. Without revival, so
    do the code vectors."""
    used, distance = {}, {}
    for revival in (1.0, 0.0):
        learner = dgrl.make(dataclasses.replace(DISCRETE, revival=revival))
        params, _ = begun(learner, VECTORS)
        # Segments have a standard deviation of less than 0.1.
        lost = params | {"codebook": params["codebook"].at[1:].add(1.0)}
        metrics = trained(learner, VECTORS, 1000, lost, part="codebook")[2]
        used[revival], distance[revival] = int(metrics["codes_used"][-1]), float(metrics["codebook_loss"][-50:].mean())
    assert used[0.0] == 1 and used[1.0] >= 12
    assert distance[1.0] < 0.3 * distance[0.0]


def test_discrete_codes_learn_to_reconstruct_goals():
    """From every goal's own discrete code its input comes back."""
    params, _, metrics = trained(dgrl.make(DISCRETE), VECTORS, 500)
    assert metrics["reconstruction_error"][-50:].mean() < 0.2 * constant_error(VECTORS)
    assert len(np.unique(dgrl.indices_of(DISCRETE, params, VECTORS), axis=0)) == len(VECTORS)
