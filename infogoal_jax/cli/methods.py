"""`infogoal methods`."""

from tyro.conf import Positional

from infogoal_jax.cli.choice import Name, Parts
from infogoal_jax.errors import UserError


def methods(
    task: Positional[str] = "",
    method: Positional[str] = "",
    learner: Name = None,
    agent: Name = None,
    relabelling: Name = None,
    explorer: Name = None,
) -> int:
    """Say which methods and tasks go together, and why others do not.

    Args:
        task: Name of a task; empty: all.
        method: Name of a method on that task; empty: all.
        learner: Name of another learner than the method's own.
        agent: Name of another agent than the task's own.
        relabelling: Name of another relabelling than the method's own.
        explorer: Name of another explorer than the method's own.

    Returns:
        0; with a task and a method 1 where they do not work together.
    """
    from infogoal_jax import presets
    from infogoal_jax.report import methods as table

    parts = Parts(None, learner, agent, relabelling, explorer).names()
    if method:
        return 0 if table.print_combination(task, method, **parts) else 1
    if parts:
        raise UserError(f"method = {method!r}: name a task and a method: infogoal methods TASK METHOD --agent ...")
    if task:
        presets.load(task)  # Refuses a name that does not exist.
    table.print_methods((task,) if task else presets.TASKS)
    return 0
