"""`infogoal export`: a policy as a file that runs elsewhere."""

import os
from pathlib import Path

from tyro.conf import Positional

from infogoal_jax.cli.commands import tell
from infogoal_jax.errors import UserError, counted, require


def export(run: Positional[str], out: str, seed: int | None = None, stablehlo: str = "") -> int:
    """Write the policy of a run as one file that runs with NumPy alone.

    Args:
        run: Folder of the run, a packed run, or shipped/NAME.
        out: File to write, which ends in .npz.
        seed: Seed of the run whose policy it is; none: its first.
        stablehlo: File to write the same as StableHLO for `jax.export.deserialize`; empty: none. Needs flatbuffers.
    """
    from infogoal_jax.report.export import export as write
    from infogoal_jax.report.runs import load_run
    from infogoal_jax.runs import disk

    require(Path(out).suffix == ".npz", "out", out, "let it end in .npz")
    require(may_be_replaced(Path(out)), "out", out, "is there already and is no exported policy; give a new file")
    disk.check_out(Path(out))
    if stablehlo:
        require(not os.path.lexists(stablehlo), "stablehlo", stablehlo, "is there already; give a new file")
        require(Path(stablehlo) != Path(out), "stablehlo", stablehlo, "give another file than --out")
    policy = write(load_run(run), Path(out), seed, Path(stablehlo) if stablehlo else None)
    about, size = policy.about, Path(out).stat().st_size / 1e6
    actions = actions_in_words(about)
    tell(f"{out}: {about['task']}, {about['method']}, seed {about['seed']}; {actions}; {size:.1f} MB")
    if stablehlo:
        tell(f"{stablehlo}: the same as StableHLO; {Path(stablehlo).stat().st_size / 1e6:.1f} MB")
    return 0


def actions_in_words(about: dict) -> str:
    """What the functions of an exported policy give. about: what its file says of it."""
    if about["discrete"]:
        return counted(about["action_size"], "action")
    if about["moves"]:
        return f"drives by {counted(about['action_size'], 'move')}, whose numbers `drive` returns"
    return f"drives by continuous actions, vectors of {about['action_size']}"


def may_be_replaced(file: Path) -> bool:
    """Whether nothing but an earlier policy is lost where a policy is written here."""
    from infogoal_jax.data import archives

    try:
        return {"about", "program"} <= archives.read(file, "").sizes.keys()
    except FileNotFoundError:
        return True
    except UserError:  # Something else than an npz.
        return False
    except OSError:  # What is written will say so.
        return True
