"""The connection to a Ray cluster: one that is there, or one of this machine for as long as the work takes."""

import contextlib
import logging
import os

from infogoal_jax.errors import UserError


@contextlib.contextmanager
def connected(address: str):
    """Inside, the process is connected to the cluster. Gives the module `ray`."""
    try:
        import ray
    except ImportError as error:
        raise UserError("engine = 'ray': is not installed; pip install 'infogoal-jax[ray]'") from error
    if ray.is_initialized():
        yield ray
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Of the cluster that is started here.
    own = {} if address else {"include_dashboard": False}
    try:
        ray.init(address=address or "local", log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise UserError(
            f"ray_address = {address!r}: {str(error).strip() or type(error).__name__}; give HOST:PORT of a cluster "
            "that this machine belongs to, auto for the one that runs here, or ray://HOST:10001"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()
