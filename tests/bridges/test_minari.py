"""Minari reads and records our tasks. Needs Minari; without it only its absence is tested."""

import importlib.util
import sys

import hand_made
import jax
import numpy as np
import pytest

from infogoal_jax.bridges.minari import import_minari
from infogoal_jax.errors import UserError

needs_minari = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("minari", "h5py", "PIL")),
    reason='needs pip install "minari[hdf5]" pillow',
)


@pytest.mark.parametrize("missing", ["minari", "h5py", "PIL"])
def test_without_minari_the_message_says_what_to_install(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError, match=r'pip install "minari\[hdf5\]" pillow'):
        import_minari()


@needs_minari
def test_minari_collects_a_task_whose_images_have_one_channel(tmp_path, monkeypatch):
    """Which it cannot keep as JPEG."""
    import gymnasium
    import minari

    from infogoal_jax.bridges.gymnasium_tasks import TaskGymnasium

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    rooms = hand_made.environment(3)
    env = TaskGymnasium(rooms.replace(images=jax.device_put(np.kron(rooms.images, np.ones((1, 4, 4), np.uint8)))))
    collector = minari.DataCollector(gymnasium.wrappers.PassiveEnvChecker(env), jpeg_encoding=False)
    seen = [collector.reset(seed=0)[0]["observation"]]
    for _ in range(3):
        observation, _, terminated, truncated, _ = collector.step(0)
        seen.append(observation["observation"])
        if terminated or truncated:
            break
    kept = collector.create_dataset("rooms-v0", eval_env=None)
    assert seen[0].shape == (32, 32, 1)
    np.testing.assert_array_equal(next(iter(kept)).observations["observation"], np.stack(seen))
