"""A run of the hand-made task in a process of its own, to be killed: `python killed_run.py FOLDER [resume]`."""

import sys
from pathlib import Path

import hand_made

from infogoal_jax.train import host


def chunk_config():
    """Chunks of two epochs, long enough that a kill may hit computing, writing a table or writing the checkpoint."""
    return hand_made.config(num_epochs=12, epochs_per_evaluation=2, updates_per_epoch=5)


if __name__ == "__main__":
    folder, resume = Path(sys.argv[1]), sys.argv[2:] == ["resume"]
    print("starting", flush=True)
    host.run(
        chunk_config(), [0, 1], folder, resume=resume and (folder / "config.json").exists(), env=hand_made.environment()
    )
