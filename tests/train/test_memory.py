"""What cannot fit into a device's memory is refused before anything is compiled or allocated, in the name of the field
that is to blame."""

import hand_made
import hand_made_frames
import jax
import pytest

from infogoal_jax import make_train
from infogoal_jax.agents.low_level import LowLevelConfig
from infogoal_jax.envs import object_manipulation
from infogoal_jax.errors import UserError
from infogoal_jax.train import distributed, memory, tune
from infogoal_jax.train.low_level import host
from infogoal_jax.train.low_level.host import preset


def test_slices_follow_from_the_memory_of_the_devices():
    """Each of 10 seeds carries 100 bytes, takes 2 x 100 + 50 while it runs, and 100 more in a slice, which divides 10;
    the environment takes 30."""
    for bytes_that_may_be_filled, at_once in ((30 + 3520, 10), (30 + 3480, 5), (30 + 2420, 2), (30 + 1360, 1)):
        assert memory.seeds_at_once(100, 50, 30, 10, round(bytes_that_may_be_filled / memory.MEMORY_SHARE)) == at_once
    with pytest.raises(UserError, match="seeds = 10"):
        memory.seeds_at_once(100, 50, 30, 10, round((30 + 1340) / memory.MEMORY_SHARE))
    with pytest.raises(UserError, match="seeds = 20.*give at most 18"):
        memory.seeds_at_once(100, 50, 30, 10, round((30 + 1340) / memory.MEMORY_SHARE), 2)


def test_what_a_scan_reads_step_by_step_lies_in_memory():
    def draw_all_then_use(key):
        numbers = jax.random.uniform(key, (1000, 8))
        return jax.lax.scan(lambda total, number: (total + number.sum(), None), 0.0, numbers)[0]

    assert memory.peak_bytes(jax.make_jaxpr(draw_all_then_use)(jax.random.key(0))) >= 32_000


@pytest.fixture
def no_compiling(monkeypatch):
    """Nothing is compiled any more."""

    def compiled(*arguments):
        raise AssertionError("something was compiled")

    monkeypatch.setattr(jax.stages.Lowered, "compile", compiled)


@pytest.mark.parametrize(
    ("changes", "seeds", "message"),
    [
        ({"num_envs": 2 * 10**9}, [0], "num_envs = 2000000000: .*GiB.*such as 1000"),
        ({"batch_size": 2 * 10**9}, [0], "batch_size = 2000000000"),
        ({"updates_per_epoch": 2 * 10**9, "num_epochs": 1}, [0], "updates_per_epoch = 2000000000"),
        ({"network": LowLevelConfig((10**6, 10**6))}, range(2), r"network.hidden = \(1000000, 1000000\)"),
        ({}, range(10**9), "seeds = 1000000000: .*such as 1"),
    ],
)
def test_sizes_of_a_low_level_are_refused(changes, seeds, message, tmp_path, monkeypatch, no_compiling):
    env = hand_made_frames.manipulation()
    monkeypatch.setattr(object_manipulation, "make", lambda config: env)
    with pytest.raises(UserError, match=message):
        host.pretrain(preset("object_manipulation", **changes), seeds, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_more_transitions_or_updates_than_can_be_numbered_are_refused():
    with pytest.raises(
        UserError, match=r"num_envs \* buffer_epochs \* episode_length = 12800000000.*at most 2147483647"
    ):
        preset("fetch_reach", num_envs=128, buffer_epochs=2 * 10**6)
    with pytest.raises(UserError, match=r"num_epochs \* updates_per_epoch = 2000000000000: .*at most 2147483647"):
        preset("object_manipulation", num_epochs=10**6, updates_per_epoch=2 * 10**6)


@pytest.mark.parametrize(("trials", "seeds"), [(10**20, [1000]), (2, range(1000, 4 * 10**9))])
def test_lanes_of_a_search_are_refused_before_they_are_drawn(trials, seeds, no_compiling):
    with pytest.raises(UserError, match=r"trials x seeds = \d+: .*give at most [1-9]"):
        tune.tune(hand_made.config("none"), trials, seeds, jax.random.key(0), env=hand_made.environment())


@pytest.mark.parametrize("changes", [{"batch_size": 2 * 10**9}, {"evaluation_starts": 2 * 10**9}], ids=str)
def test_seeds_are_not_blamed_where_not_even_one_fits(changes, no_compiling):
    train = make_train(hand_made.config(**changes), hand_made.environment())
    with pytest.raises(UserError, match=f"{next(iter(changes))} = "):
        memory.at_once(train, 100_000, distributed.seed_mesh(1))
