"""Layers that give each other bfloat16, in updates that are asked for it."""

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import make_train, networks
from infogoal_jax.exploration.sse_db import Projection

IMAGES = jnp.asarray(np.random.default_rng(0).integers(0, 256, (5, 16, 16, 3)), jnp.uint8)
VECTORS = jnp.asarray(np.random.default_rng(1).normal(size=(5, 7)), jnp.float32)
NETWORKS = {
    "an MLP": (networks.MLP((32, 32), 6, layer_norm=True), VECTORS),
    "of OGBench": (networks.GeluMLP((32, 32), 6, layer_norm=True), VECTORS),
    "a goal encoder": (networks.GaussianEncoder((32, 32), 6, standardise=True), IMAGES),
    "a decoder": (networks.GoalDecoder((32,), (16, 16, 3)), VECTORS),
    "a state encoder": (networks.PatchEncoder(8, 8, 32), IMAGES),
    "an explorer's projection": (Projection(32, 6), VECTORS),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_layers_take_and_give_bfloat16_and_parameters_and_what_comes_out_are_float32(name):
    network, inputs = NETWORKS[name]
    params = jax.jit(network.init)(jax.random.key(0), inputs)
    with networks.activations("bfloat16"):
        drawn = jax.jit(network.init)(jax.random.key(0), inputs)
    jax.tree.map(np.testing.assert_array_equal, params, drawn)

    def loss(params):
        outputs = network.apply(params, inputs)
        return sum(jnp.square(each).mean() for each in jax.tree.leaves(outputs)), outputs

    step = jax.jit(jax.grad(loss, has_aux=True))
    exact = step(params)
    with networks.activations("bfloat16"):
        half = step(params)
        assert "bf16" in str(jax.make_jaxpr(loss)(params))
    assert "bf16" not in str(jax.make_jaxpr(loss)(params))
    for one, other in zip(jax.tree.leaves(exact), jax.tree.leaves(half), strict=True):
        assert one.dtype == other.dtype == jnp.float32
        assert 0 < jnp.linalg.norm(one - other) < 0.03 * jnp.linalg.norm(one)


def test_updates_have_bfloat16_and_only_where_it_is_asked_for():
    """What a run gives has the same types either way; no type is promoted in silence."""
    given = hand_made.environment()
    trains = {asked: make_train(hand_made.config(bfloat16=asked), given) for asked in (False, True)}
    with jax.numpy_dtype_promotion("strict"):
        programs = {asked: str(jax.make_jaxpr(train)(jax.random.key(0))) for asked, train in trains.items()}
    assert "bf16" not in programs[False] and "bf16" in programs[True]
    without, with_it = (jax.eval_shape(train, jax.random.key(0)) for train in trains.values())
    assert jax.tree.map(jnp.result_type, without) == jax.tree.map(jnp.result_type, with_it)
