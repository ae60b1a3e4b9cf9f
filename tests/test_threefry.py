"""Keys with Threefry's rounds written out give jax's own random numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax.threefry import written_out

DRAWS = {
    "bits of 8": lambda key: jax.random.bits(key, (7, 3), jnp.uint8),
    "bits of 16": lambda key: jax.random.bits(key, (7, 3), jnp.uint16),
    "bits of 32": lambda key: jax.random.bits(key, (7, 3)),
    "uniform": lambda key: jax.random.uniform(key, (5, 4), minval=-1.0),
    "normal": lambda key: jax.random.normal(key, (301,)),
    "a number": lambda key: jax.random.normal(key),
    "integers": lambda key: jax.random.randint(key, (9,), 0, 17),
    "permutation": lambda key: jax.random.permutation(key, 50),
    "choice": lambda key: jax.random.choice(key, jnp.arange(10), (4,)),
    "keys": lambda key: jax.random.key_data(jax.random.split(key, (3, 2))),
    "a folded key": lambda key: jax.random.key_data(jax.random.fold_in(key, 2**32 - 1)),
}


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS)
def test_whatever_is_drawn_is_what_jax_draws(draw):
    keys = jax.random.split(jax.random.key(3), 4)
    np.testing.assert_array_equal(jax.vmap(draw)(written_out(keys)), jax.vmap(draw)(keys))


def test_keys_of_other_generators_are_left_alone():
    key = jax.random.key(0, impl="rbg")
    assert written_out(key) is key
    once = written_out(jax.random.key(0))
    assert written_out(once) is once
