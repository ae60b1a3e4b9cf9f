"""What a program costs. Compiling: programs that stay small, options that leave the user's own alone, and a cache that
works across processes and is nobody's surprise. Memory: what cannot fit into a device's is refused before anything is
compiled or allocated, in the name of the field that is to blame."""

import dataclasses
import gc
import os
import subprocess
import sys

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed.training import operations
from infogoal_jax import compiled, make_train, presets, use_compilation_cache
from infogoal_jax.errors import UserError
from infogoal_jax.report.figures import draw_figures
from infogoal_jax.runner import compilation, distributed, memory, search
from infogoal_jax.runner.compilation import OPTIONS, chunk_of, compiler_options, compiling_quickly
from infogoal_jax.runner.training import run

COUNT_HITS = """
import sys
import jax
import infogoal_jax

assert jax.config.jax_compilation_cache_dir is None, "an import has set the cache"
infogoal_jax.use_compilation_cache(sys.argv[1])
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name) if name.endswith("cache_hits") else None)
def program(x):
    return jax.lax.fori_loop(0, 10, lambda _, y: jax.numpy.linalg.qr(y)[0] @ x, x)
infogoal_jax.jit(program)(jax.numpy.ones((8, 8)))
print(len(hits))
"""


def cache_hits(folder) -> int:
    """Programs that a new process, which compiles the same few, finds in the cache."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("JAX_") and name != "XLA_FLAGS"
    }
    command = [sys.executable, "-c", COUNT_HITS, str(folder)]
    done = subprocess.run(
        command, env=environment | {"JAX_PLATFORMS": "cpu"}, capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.long
def test_a_second_process_finds_what_the_first_compiled(tmp_path):
    assert cache_hits(tmp_path / "cache") == 0
    assert cache_hits(tmp_path / "cache") > 0


def test_a_folder_that_cannot_be_made_costs_the_cache_and_nothing_else(tmp_path):
    (tmp_path / "file").write_text("in the way")
    before = jax.config.jax_compilation_cache_dir
    assert use_compilation_cache(tmp_path / "file" / "cache") is None
    assert jax.config.jax_compilation_cache_dir == before


def test_options_that_the_user_has_set_are_left_alone(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    assert compiler_options() == {"xla_backend_optimization_level": 1}
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=3")
    assert compiler_options() == {}


def test_what_runs_for_seconds_is_compiled_quickly(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(compilation, "is_known", lambda option, value: True)
    usual = compiler_options()
    with compiling_quickly():
        assert compiler_options() == usual | {"xla_cpu_use_fusion_emitters": False}
        with compiling_quickly(False):
            assert compiler_options() == usual
    assert compiler_options() == usual


def test_each_kind_of_device_has_options_of_its_own(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(compilation, "is_known", lambda option, value: True)
    assert compiler_options() == OPTIONS["gpu"]


def test_options_that_the_compiler_does_not_have_are_left_out(monkeypatch):
    """Each version of jax brings some and drops others."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setitem(OPTIONS, "cpu", OPTIONS["cpu"] | {"xla_option_of_long_ago": True})
    assert compiler_options() == {"xla_backend_optimization_level": 1}
    monkeypatch.setitem(OPTIONS, "cpu", {"xla_backend_optimization_level": "high"})
    with pytest.raises(jax.errors.JaxRuntimeError):  # Known, but not with this value: that is no reason to be silent.
        compiler_options()


def test_garbage_is_collected_again_after_compiling_and_after_an_error():
    program = compiled(lambda x, y: x * y, jnp.ones(3), jnp.ones(3), donate_argnums=0)
    np.testing.assert_array_equal(program(jnp.arange(3.0), jnp.ones(3)), [0, 1, 2])
    assert gc.isenabled()
    with pytest.raises(ValueError, match="matmul"):
        compiled(lambda x: x @ 1, jnp.ones(3))
    assert gc.isenabled()


@pytest.mark.long
def test_a_chunk_in_two_programs_is_the_chunk_of_training():
    train = make_train(hand_made.config("infogoal", updates_per_epoch=2), hand_made.environment())
    shared = jnp.arange(1), train.config.hyper, train.env
    begin = jax.jit(lambda: train.initial(jax.random.key(0), *shared[1:]))
    finish = chunk_of(train.epochs, train.evaluation).compiling(jax.eval_shape(begin), *shared)
    states, expected = begin(), jax.jit(train.chunk)(begin(), *shared)
    found = finish()(states, shared[0])
    assert jax.tree.leaves(states.params)[0].is_deleted()  # Its memory was given back.
    for one, two in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        if not jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
            np.testing.assert_allclose(one, two, atol=1e-5)


def test_a_chunk_that_cannot_be_compiled_says_so():
    chunk = chunk_of(lambda states, numbers: (states @ numbers, {}), lambda states: {})
    with pytest.raises(TypeError, match="dot_general|matmul"):
        chunk.compiling(jnp.ones(3), jnp.ones(4))


def test_of_what_has_a_form_for_each_device_one_is_counted():
    def program(x):
        return jax.lax.platform_dependent(x, cuda=lambda x: jnp.sin(jnp.cos(x)) + 1, default=lambda x: x + 1)

    traced = jax.make_jaxpr(jax.vmap(program))(jnp.ones(3))
    assert operations(traced, "cuda") - operations(traced, "cpu") == 2


@pytest.mark.parametrize(
    ("task", "most"),
    [
        ("rooms", 3_300),
        pytest.param("object_search", 3_300, marks=pytest.mark.long),
        pytest.param("fetch_reach", 10_200, marks=pytest.mark.long),
        pytest.param("fetch_pick_and_place", 12_500, marks=pytest.mark.long),
    ],
)
def test_training_programs_stay_small(task, most):
    """Operations of the chunk of a preset, or of object search in the hand-made rooms, which need no house. What
    compiles it takes time in proportion; FetchPickAndPlace once had 81,663."""
    config = hand_made.config() if task == "rooms" else presets.load(task)
    train = make_train(config, hand_made.environment() if task == "rooms" else None)
    state = train.state_shapes
    assert (
        operations(
            jax.make_jaxpr(train.chunk)(state, jnp.arange(config.epochs_per_evaluation), config.hyper, train.env)
        )
        < most
    )


def test_slices_follow_from_the_memory_of_the_devices():
    """Each of 10 seeds carries 100 bytes, takes 2 x 100 + 50 while it runs, and 100 more in a slice, which divides 10;
    the environment takes 30."""
    for bytes_that_may_be_filled, at_once in ((30 + 3520, 10), (30 + 3480, 5), (30 + 2420, 2), (30 + 1360, 1)):
        assert (
            memory.seeds_at_once(100, 50, 30, 10, round(bytes_that_may_be_filled / memory.MEMORY_FRACTION)) == at_once
        )
    with pytest.raises(UserError, match="seeds = 10"):
        memory.seeds_at_once(100, 50, 30, 10, round((30 + 1340) / memory.MEMORY_FRACTION))
    with pytest.raises(UserError, match="seeds = 20.*give at most 18"):
        memory.seeds_at_once(100, 50, 30, 10, round((30 + 1340) / memory.MEMORY_FRACTION), 2)


def test_the_largest_array_of_a_loop_counts():
    def doubled(total, number):
        return jax.lax.scan(lambda inner, each: (inner + each, inner[:, None] * each), total, number)

    program = jax.make_jaxpr(lambda numbers: jax.lax.scan(doubled, jnp.zeros(8), numbers))(jnp.ones((2, 1000, 8)))
    assert memory.largest_array(program) >= 1000 * 8 * 8 * 4


def test_what_a_compiled_program_needs_is_compared_with_the_device():
    compiled = jax.jit(lambda x: jnp.sort(x @ x.T)).lower(jnp.ones((100, 100))).compile()
    memory.check_compiled([compiled], hand_made.config(), lambda: hand_made.config(), 10**9)
    with pytest.raises(UserError, match=r"batch_size = 64: .*such as 32"):
        larger = hand_made.config(batch_size=64)
        memory.check_compiled([compiled], larger, lambda: dataclasses.replace(larger, batch_size=32), 1000)


def test_of_a_gpu_it_is_said_which_fraction_jax_takes(monkeypatch):
    """59.4 GiB of a card of 80 looked like another card."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.delenv("XLA_PYTHON_CLIENT_MEM_FRACTION", raising=False)
    of_its_memory = "of its memory, the fraction that XLA_PYTHON_CLIENT_MEM_FRACTION lets jax take"
    assert memory.room_in_words(60 * 2**30) == f"a device has 60.0 GiB: 0.75 {of_its_memory}"
    monkeypatch.setenv("XLA_PYTHON_CLIENT_MEM_FRACTION", ".3")
    assert f"GiB: .3 {of_its_memory}" in memory.room_in_words(2**30)


@pytest.fixture
def no_compiling(monkeypatch):
    """Nothing is compiled any more."""

    def compiled(*arguments):
        raise AssertionError("something was compiled")

    monkeypatch.setattr(jax.stages.Lowered, "compile", compiled)


@pytest.mark.parametrize(("trials", "seeds"), [(10**20, [1000]), (2, range(1000, 4 * 10**9))])
def test_settings_of_a_search_are_refused_before_they_are_drawn(trials, seeds, no_compiling):
    with pytest.raises(UserError, match=r"trials x seeds = \d+: .*give at most [1-9]"):
        search.tune(hand_made.config("none"), trials, seeds, jax.random.key(0), env=hand_made.environment())


@pytest.mark.parametrize("changes", [{"batch_size": 2 * 10**9}, {"evaluation_starts": 2 * 10**9}], ids=str)
def test_seeds_are_not_blamed_where_not_even_one_fits(changes, no_compiling):
    train = make_train(hand_made.config(**changes), hand_made.environment())
    needs = r"training needs [\d,.]+ GiB, a device has [\d,.]+ GiB: give a smaller value"
    with pytest.raises(UserError, match=f"{next(iter(changes))} = 2000000000: {needs}"):
        memory.at_once(train, 100_000, distributed.seed_mesh(1))


def test_recordings_are_blamed_where_nothing_else_is_larger():
    config = presets.load("point_maze", "none")
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, dataset="walks.npz"))
    said = str(memory.too_large(config, config, 90 * memory.GIB, 80 * memory.GIB))
    assert said.startswith("env.dataset = 'walks.npz': training needs 90.0 GiB, a device has 80.0 GiB: leave out some")


@pytest.mark.long
def test_figures_take_a_handful_of_programs(tmp_path):
    """What is not jitted is compiled operation by operation: hundreds of programs, and each takes its time on a GPU."""
    env = hand_made.environment_from_above()
    sweep, programs = run(hand_made.config(), [0], tmp_path / "run", env=env), []

    def count(event, seconds, **_):
        if event.endswith("backend_compile_duration"):
            programs.append(seconds)

    jax.clear_caches()
    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        assert draw_figures(sweep.folder, env)
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    assert 0 < len(programs) <= 8
