"""Learners that reconstruct goals. The VAE: its decoder and its bound. DGRL: codes are discrete and stay in use,
gradients go where they should, and goals are reconstructed."""

import dataclasses

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made import SMALL, begun, constant_error, loss_of, trained

from infogoal_jax import networks
from infogoal_jax.learners import dgrl, vae
from infogoal_jax.loading import make_train

RANDOM = np.random.default_rng(10)
VECTORS = jax.device_put(RANDOM.normal(size=(8, 16)).astype(np.float32) / 4)
"""Of length 1, about, as sentence embeddings are."""
IMAGES = jax.device_put(RANDOM.integers(0, 256, (6, 4, 4, 3), np.uint8).repeat(4, 1).repeat(4, 2))
"""Of squares, 16 x 16."""
DISCRETE = dgrl.DGRLConfig(factors=4, codes=16, **SMALL)


def test_patches_are_put_back_together():
    images = jnp.arange(2 * 8 * 12 * 3).reshape(2, 8, 12, 3)
    for side in (2, 4):
        np.testing.assert_array_equal(networks.unpatched(networks.patches(images, side), side), images)


@pytest.mark.parametrize("standardise", [False, True])
def test_layers_of_images_have_32_bits_whatever_jax_is_set_to(standardise):
    layers = networks.GoalLayers((32, 16), 8, standardise)
    with jax.enable_x64(True):
        made = jax.eval_shape(layers.init_with_output, jax.random.key(0), IMAGES)
    assert {leaf.dtype for leaf in jax.tree.leaves(made)} == {np.dtype("float32")}


@pytest.mark.parametrize("standardise", [pytest.param(False, marks=pytest.mark.long), True])
def test_targets_are_what_the_encoders_first_layer_sees(standardise):
    layers = networks.ImageLayers(standardise)
    params = jax.jit(layers.init)(jax.random.key(0), IMAGES)
    first, second = params["params"]["Dense_0"], params["params"]["Dense_1"]
    seen = networks.patches(networks.as_encoded(IMAGES, standardise), 4)
    values = networks.patches(jax.nn.relu(seen @ first["kernel"] + first["bias"]), 2)
    values = jax.nn.relu(values @ second["kernel"] + second["bias"])
    np.testing.assert_allclose(values.reshape(len(IMAGES), -1), layers.apply(params, IMAGES), atol=1e-4)


def test_pixels_that_stay_bytes_until_the_product_have_the_same_values():
    levels = jnp.arange(256, dtype=jnp.uint8)
    np.testing.assert_array_equal(networks.scaled_in_the_product(levels), networks.to_scale(levels))


@pytest.mark.parametrize("shape", [(5,), (16, 24, 3)])
def test_decoder_gives_back_the_shape_of_the_input(shape):
    decoder = networks.GoalDecoder((7, 9), shape)
    decoded, _ = jax.eval_shape(lambda key: decoder.init_with_output(key, jnp.zeros((2, 3, 4))), jax.random.key(0))
    assert decoded.shape == (2, 3, *shape)


@pytest.mark.long
def test_elbo_is_a_bound_in_nats():
    """It is the mean logarithm of the importance weights p(z) p(g | z) / q(z | g), so that the logarithm of their mean,
    log p(g), lies above it. A mean over the input instead of a sum, a missing half, another variance or a KL the wrong
    way round are not."""
    learner = vae.make(vae.VAEConfig(latent_size=2, hidden=(8,), vector_std=2.0))
    inputs = 3.0 * jax.random.normal(jax.random.key(0), (1, 5))
    params, state = begun(learner, inputs)
    elbo_of = jax.jit(jax.vmap(lambda key: loss_of(learner, inputs, params, state, key)[1][0]["elbo"]))
    elbo = elbo_of(jax.random.split(jax.random.key(2), 4000)).mean()
    code = learner.encode(params, inputs)
    draws = code.mean + code.std * jax.random.normal(jax.random.key(3), (20_000, 2))
    decoded = networks.GoalDecoder((8,), (5,)).apply(params["decoder"], draws)
    # Less its constant.
    log_likelihood = jax.scipy.stats.norm.logpdf(inputs, decoded, 2.0).sum(-1) + 5 * jnp.log(2.0 * jnp.sqrt(2 * jnp.pi))
    log_prior = jax.scipy.stats.norm.logpdf(draws).sum(-1)
    log_weight = log_prior + log_likelihood - jax.scipy.stats.norm.logpdf(draws, code.mean, code.std).sum(-1)
    # Of some 27 nats, 9 of which are the KL; the mean of the draws is known to 0.02.
    assert abs(elbo - log_weight.mean()) < 0.1
    assert elbo < jax.nn.logsumexp(log_weight) - jnp.log(len(draws))


def test_kl_is_zero_for_a_posterior_that_is_the_prior():
    learner = vae.make(vae.VAEConfig(**SMALL))
    params, state = begun(learner, VECTORS)
    # All means are 0 then; and softplus is 1 - MINIMUM_STD at its inverse.
    params = jax.tree.map(jnp.zeros_like, params)
    raw = jnp.log(jnp.expm1(1.0 - networks.MINIMUM_STD))
    last = params["encoder"]["params"]["GoalLayers_0"]["MLP_0"]["Dense_2"]
    last["bias"] = last["bias"].at[SMALL["latent_size"] :].set(raw)
    kl = loss_of(learner, VECTORS, params, state, jax.random.key(1))[1][0]["kl"]
    assert abs(kl) < 1e-6
    last["bias"] = last["bias"].at[:2].set(3.0)
    np.testing.assert_allclose(
        loss_of(learner, VECTORS, params, state, jax.random.key(1))[1][0]["kl"], 2 * 3.0**2 / 2, rtol=1e-5
    )


@pytest.mark.parametrize("inputs", [VECTORS, pytest.param(IMAGES, marks=pytest.mark.long)], ids=["vectors", "images"])
def test_vae_learns_to_reconstruct_goals(inputs):
    """The bound rises, and the mean code tells which goal it is of."""
    config = vae.VAEConfig(**SMALL)
    params, _, metrics = trained(vae.make(config), inputs, 400)
    assert metrics["elbo"][-50:].mean() > metrics["elbo"][:20].mean() + 10
    means = jax.jit(vae.make(config).encode)(params, inputs).mean
    error = vae.squared_error(params["decoder"], config.hidden, means, inputs, False).mean() / inputs[0].size
    assert error < 0.5 * constant_error(inputs)
    others = (
        vae.squared_error(params["decoder"], config.hidden, jnp.roll(means, 1, axis=0), inputs, False).mean()
        / inputs[0].size
    )
    assert others > constant_error(inputs)


@pytest.mark.long
def test_a_large_beta_or_a_coarse_decoder_empties_the_code():
    """The latter is why vectors, whose numbers are small, have a standard deviation of their own."""
    kl = {
        (beta, std): float(
            trained(vae.make(vae.VAEConfig(vae_beta=beta, vector_std=std, warm_up=0, **SMALL)), VECTORS, 400)[2]["kl"][
                -50:
            ].mean()
        )
        for beta, std in ((1.0, 0.05), (30.0, 0.05), (1.0, 1.0))
    }
    assert kl[1.0, 0.05] > np.log(len(VECTORS))  # Enough to tell the goals apart.
    assert kl[30.0, 0.05] < 0.5 * kl[1.0, 0.05]
    assert kl[1.0, 1.0] < 0.1


def test_the_kl_s_weight_rises_over_the_warm_up():
    """From nothing to vae_beta, and no further: the loss less the reconstruction's is that share of the KL."""
    learner = vae.make(vae.VAEConfig(vae_beta=2.0, warm_up=4, vector_std=1.0, **SMALL))
    params, state = begun(learner, VECTORS)
    size = VECTORS[0].size
    for share in (0.25, 0.5, 0.75, 1.0, 1.0):
        loss, (metrics, state) = loss_of(learner, VECTORS, params, state, jax.random.key(0))
        surprise = 0.5 * metrics["reconstruction_error"] * size
        np.testing.assert_allclose(loss * size - surprise, 2.0 * share * metrics["kl"], rtol=1e-4)


@pytest.mark.parametrize("standardise", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.parametrize("method", ["vae", pytest.param("dgrl", marks=pytest.mark.long)])
def test_contrast_counts_for_nothing_where_images_are_standardised(method, standardise):
    """The target is standardised with the input."""
    faint = (96 + 0.25 * IMAGES.astype(jnp.float32)).astype(jnp.uint8)
    part, config = {"vae": (vae, vae.VAEConfig), "dgrl": (dgrl, dgrl.DGRLConfig)}[method]
    learner = part.make(config(standardise_images=standardise, **SMALL))
    params, state = begun(learner, IMAGES)
    error_of = jax.jit(
        lambda images: loss_of(learner, images, params, state, jax.random.key(1))[1][0]["reconstruction_error"]
    )
    assert np.isclose(error_of(IMAGES), error_of(faint), rtol=0.02) == standardise


@pytest.mark.long
@pytest.mark.parametrize("method", ["vae", "dgrl"])
def test_trains_on_the_hand_made_task(method):
    config = hand_made.config(
        method, num_epochs=1, epochs_per_evaluation=1, updates_per_epoch=3, batch_size=8, rollout_steps=20
    )
    result = jax.jit(make_train(config, hand_made.environment(8)))(jax.random.key(0))
    for name, values in {**result.metrics, **result.epochs}.items():
        assert np.isfinite(values).all(), name
    assert f"{method}/reconstruction_error" in result.epochs
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.params))


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


def segments_of(encoder_params, goals) -> np.ndarray:
    """The segments of the codes of goals before quantisation, [N, factors, d / factors]."""
    return np.asarray(jax.jit(dgrl.segments_of, static_argnums=0)(DISCRETE, encoder_params, goals))


def test_codebook_starts_among_the_segments_of_goals():
    params, _ = begun(dgrl.make(DISCRETE), VECTORS)
    segments = segments_of(params["encoder"], VECTORS).reshape(-1, 2)
    distance = np.linalg.norm(np.asarray(params["codebook"])[:, None] - segments, axis=-1).min(1)
    assert (distance < 0.1 * segments.std()).all()
    assert len(np.unique(params["codebook"], axis=0)) == DISCRETE.codes


@jax.jit
def nearest_of(params, goals):
    """See `indices_of`."""
    return dgrl.nearest(dgrl.segments_of(DISCRETE, params["encoder"], goals), params["codebook"])


def indices_of(params, goals) -> np.ndarray:
    """The indices of the code vectors of goals, int [N, factors]."""
    return np.asarray(nearest_of(params, goals))


def test_each_segment_is_replaced_by_the_nearest_code_vector(discrete):
    learner, params, _ = discrete
    segments = segments_of(params["encoder"], VECTORS)
    codes = np.asarray(jax.jit(learner.encode)(params, VECTORS).mean).reshape(segments.shape)
    indices = indices_of(params, VECTORS)
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
    distinct = np.unique(jax.jit(learner.encode)(params, goals).mean, axis=0)
    assert 3 < len(distinct) <= 81
    assert len(distinct) == len(np.unique(indices_of(params, goals), axis=0))


def test_the_agents_gradient_passes_the_replacement_and_never_reaches_the_codebook(discrete):
    learner, params, _ = discrete
    weights = jax.random.normal(jax.random.key(3), (len(VECTORS), 8))
    segments, vectors = jax.random.normal(jax.random.key(4), (2, 5, 2))
    np.testing.assert_array_equal(
        jax.grad(lambda y: (weights[:5, :2] * dgrl.straight_through(y, vectors)).sum())(segments), weights[:5, :2]
    )

    gradient = jax.jit(jax.grad(lambda params: (weights * learner.encode(params, VECTORS).mean).sum()))(params)
    assert not gradient["codebook"].any()
    plain = networks.GoalLayers(DISCRETE.hidden, DISCRETE.latent_size)
    identity = jax.jit(jax.grad(lambda encoder: (weights * plain.apply(encoder, VECTORS)).sum()))(params["encoder"])
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


@pytest.mark.long
def test_only_code_vectors_that_were_idle_for_long_are_revived(discrete):
    _, params, state = discrete
    state = state.replace(idle=jnp.full(DISCRETE.codes, dgrl.PATIENCE - 1).at[3].set(dgrl.PATIENCE))
    segments = dgrl.segments_of(DISCRETE, params["encoder"], VECTORS).reshape(-1, 2)
    indices = dgrl.nearest(segments, params["codebook"])
    to_codebook, to_segments = jax.jit(jax.grad(dgrl.revival_loss, argnums=(0, 1)))(
        params["codebook"], segments, indices, state
    )
    assert to_codebook[3].any() and not jnp.delete(to_codebook, 3, axis=0).any() and not to_segments.any()
    moved = params["codebook"][3] - DISCRETE.codes / 2 * to_codebook[3]  # To where the pull would end.
    assert jnp.linalg.norm(segments - moved, axis=1).min() < 1e-5


def test_use_is_counted():
    state = dgrl.DGRLState(jnp.zeros(3), jnp.array([0, 5, 7]), jnp.zeros((3, 2)))
    used = np.array([[0, 0], [0, 2]])
    state = jax.jit(lambda state: jax.lax.fori_loop(0, 1000, lambda _, state: dgrl.after_use(state, used), state))(
        state
    )
    np.testing.assert_array_equal(state.idle, [0, 1005, 0])
    np.testing.assert_allclose(state.usage, [0.75, 0, 0.25], atol=1e-3)
    np.testing.assert_allclose(
        dgrl.perplexity(state.usage), np.exp(-0.75 * np.log(0.75) - 0.25 * np.log(0.25)), rtol=1e-3
    )
    assert dgrl.perplexity(jnp.full(8, 0.01)) == pytest.approx(8, rel=1e-4)


@pytest.mark.long
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
    assert len(np.unique(indices_of(params, VECTORS), axis=0)) == len(VECTORS)
