"""Random keys that compile quickly: jax's own random numbers, from Threefry with its rounds unrolled.

On a CPU jax runs the rounds of Threefry in a loop. XLA compiles every operation of that loop by itself, again for each
draw of a program, so that random numbers take more time to compile than the networks that they are for. Unrolled,
the rounds are one fused loop over the numbers, which compiles and runs three times as fast. Other devices get the same
operations as from jax.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl, threefry_prng_impl

ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
"""Bits by which the second word is rotated, in four rounds and in the four after them."""
PARITY = np.uint32(0x1BD11BDA)
TYPES = {8: jnp.uint8, 16: jnp.uint16, 32: jnp.uint32, 64: jnp.uint64}


def unrolled(key: jax.Array) -> jax.Array:
    """The same keys with Threefry's rounds unrolled: whatever is drawn from them is what is drawn from `key`, bit
    for bit. Keys of other generators are returned as they are."""
    if jax.random.key_impl(key) != "threefry2x32":
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key), impl=UNROLLED)


def fold(key: jax.Array, *numbers: int | jax.Array) -> jax.Array:
    """The key for these numbers, such as a purpose and an epoch, folded in one after another. Everything that a program
    draws comes from such a key, so that its draws compile quickly."""
    key = unrolled(key)
    for number in numbers:
        key = jax.random.fold_in(key, number)
    return key


def from_seed(seed: int | jax.Array) -> jax.Array:
    """The key of a seed."""
    return unrolled(jax.random.key(seed))


def restored(data: jax.Array, like: jax.Array) -> jax.Array:
    """The keys whose numbers are these, of the generator that `like`, or its shape, has."""
    keys = jax.random.wrap_key_data(data)
    return keys if keys.dtype == like.dtype else unrolled(keys)


def draw_chance(key: jax.Array, probability, shape: tuple[int, ...] = ()) -> jax.Array:
    """Draw True with this probability, bool [*shape]: as `jax.random.bernoulli`, from float32 wherever jax would take
    another type."""
    return jax.random.uniform(key, shape, jnp.float32) < probability


def is_key(leaf: jax.Array) -> bool:
    """Whether a leaf is an array of typed PRNG keys."""
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def threefry(key: jax.Array, high, low: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Threefry-2x32 with 20 rounds (Salmon et al. 2011) of counters in two words, under a key uint32 [2]."""
    words = key[0], key[1], key[0] ^ key[1] ^ PARITY
    first, second = high + words[0], low + words[1]
    for group in range(5):
        for bits in ROTATIONS[group % 2]:
            first = first + second
            rotated = jax.lax.shift_left(second, np.uint32(bits)) | jax.lax.shift_right_logical(
                second, np.uint32(32 - bits)
            )
            second = first ^ rotated
        first = first + words[(group + 1) % 3]
        second = second + words[(group + 2) % 3] + np.uint32(group + 1)
    return first, second


def counters(shape: tuple[int, ...]) -> jax.Array:
    """The numbers from 0 in this shape, the low words of counters."""
    return jax.lax.iota(jnp.uint32, int(np.prod(shape, dtype=np.int64))).reshape(shape)


def random_bits(key: jax.Array, width: int, shape: tuple[int, ...]) -> jax.Array:
    """Random bits of an unsigned type, [*shape]."""
    first, second = (word.astype(TYPES[width]) for word in threefry(key, np.uint32(0), counters(shape)))
    bits = jax.lax.shift_left(first, TYPES[width](32)) | second if width == 64 else first ^ second
    # Else every fused loop that uses the numbers would draw them again, once for each number that it computes.
    return jax.lax.platform_dependent(bits, cpu=jax.lax.optimization_barrier, default=lambda bits: bits)


UNROLLED = define_prng_impl(
    key_shape=threefry_prng_impl.key_shape,
    seed=threefry_prng_impl.seed,
    split=threefry_prng_impl.split,
    fold_in=threefry_prng_impl.fold_in,
    random_bits=random_bits,
    name="unrolled_threefry",
)
