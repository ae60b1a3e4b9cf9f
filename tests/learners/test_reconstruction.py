"""Learners that reconstruct goals: the decoder, the VAE's bound, and training on the hand-made task."""

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made_codes import IMAGES, SMALL, VECTORS, begun, constant_error, loss_of, trained

from infogoal_jax import networks
from infogoal_jax.learners import dgrl, vae
from infogoal_jax.train.program import make_train


def test_patches_are_put_back_together():
    images = jnp.arange(2 * 8 * 12 * 3).reshape(2, 8, 12, 3)
    for side in (2, 4):
        np.testing.assert_array_equal(networks.unpatched(networks.patches(images, side), side), images)


@pytest.mark.parametrize("standardise", [False, True])
def test_targets_are_what_the_encoders_first_layer_sees(standardise):
    layers = networks.ImageLayers(standardise)
    params = jax.jit(layers.init)(jax.random.key(0), IMAGES)
    first, second = params["params"]["Dense_0"], params["params"]["Dense_1"]
    seen = networks.patches(networks.as_encoded(IMAGES, standardise), 4)
    values = networks.patches(jax.nn.relu(seen @ first["kernel"] + first["bias"]), 2)
    values = jax.nn.relu(values @ second["kernel"] + second["bias"])
    np.testing.assert_allclose(values.reshape(len(IMAGES), -1), layers.apply(params, IMAGES), atol=1e-4)


@pytest.mark.parametrize("shape", [(5,), (16, 24, 3)])
def test_decoder_gives_back_the_shape_of_the_input(shape):
    decoder = networks.GoalDecoder((7, 9), shape)
    decoded, _ = jax.eval_shape(lambda key: decoder.init_with_output(key, jnp.zeros((2, 3, 4))), jax.random.key(0))
    assert decoded.shape == (2, 3, *shape)


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


@pytest.mark.parametrize("inputs", [VECTORS, IMAGES], ids=["vectors", "images"])
def test_vae_learns_to_reconstruct_goals(inputs):
    """The bound rises, and the mean code tells which goal it is of."""
    config = vae.VAEConfig(**SMALL)
    params, _, metrics = trained(vae.make(config), inputs, 400)
    assert metrics["elbo"][-50:].mean() > metrics["elbo"][:20].mean() + 10
    means = vae.make(config).encode(params, inputs).mean
    error = vae.squared_error(params["decoder"], config.hidden, means, inputs, False).mean() / inputs[0].size
    assert error < 0.5 * constant_error(inputs)
    others = (
        vae.squared_error(params["decoder"], config.hidden, jnp.roll(means, 1, axis=0), inputs, False).mean()
        / inputs[0].size
    )
    assert others > constant_error(inputs)


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


@pytest.mark.parametrize("standardise", [True, False])
@pytest.mark.parametrize("method", ["vae", "dgrl"])
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
