"""The four Fetch tasks: object, goals and start poses. Source: envs/fetch of gymnasium-robotics 1.4.2 (version 4 of the
environments)."""

import dataclasses
from typing import Literal

from infogoal_jax.errors import require, require_known
from infogoal_jax.field_types import Share, Size

# Joints in the order of fetch.xml: shoulder pan and lift, upper arm roll, elbow flex, forearm roll, wrist flex and
# roll, right and left finger. Each start is where the reference's own set-up (200 steps of 2 ms, MuJoCo 3.3.7) leaves
# the robot: positions in rad and m, velocities per second.
ABOVE_TABLE = (
    (0.009950557, -0.825638597, -0.003624171, 1.443894729, 0.003060722, 0.953218499, 0.005518151,
     0.000003836, 0.000000064),
    (0.000746363, 0.00647108, -0.001392052, -0.002199827, 0.0011033, -0.001160294, -0.000928445,
     -0.000024704, 0.000001913),
)  # fmt: skip
ABOVE_TABLE_BLOCKED = (
    (0.009951729, -0.825638559, -0.003624849, 1.443894686, 0.003059309, 0.953218534, 0.005519638,
     0.000390056, 0.000011703),
    (0.000744489, 0.006471044, -0.001390179, -0.002199885, 0.001102949, -0.001160168, -0.000928528,
     0.00016639, -0.000073546),
)  # fmt: skip
ON_TABLE = (
    (0.012382534, -0.589416898, -0.005435217, 1.453137995, 0.002138829, 0.699145164, 0.007580734,
     -0.000002456, 0.001213634),
    (0.00532216, 0.002758431, -0.003969374, 0.007774312, 0.000282214, 0.021664267, 0.003075558,
     0.000006279, 0.001871386),
)  # fmt: skip
ON_LONG_TABLE = (
    (0.013981483, -0.586466932, -0.006729218, 1.450737336, 0.00103377, 0.69325855, 0.009155118,
     -0.000004164, 0.001555941),
    (0.009600596, 0.000791797, -0.006937516, 0.011928366, -0.002064868, 0.035718878, 0.007463585,
     0.000005677, 0.002958526),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Task:
    """One task. Lengths in m."""

    name: str
    start: tuple[tuple[float, ...], tuple[float, ...]]
    """Joint positions and velocities at the start of every episode."""
    start_grip: tuple[float, float, float]
    """Where the grip stands then; goals and objects are placed around it."""
    object_height: float | None = None
    """Height of the object's centre on the table, and of goals there; None: no object."""
    start_height: float | None = None
    """Height of the object's centre at the start where it is another: the reference's puck sinks 6.5 mm into the table,
    ours rests on it."""
    object_range: float = 0.15
    """The object starts at most this far from the grip along x and y, and at least 0.1 away."""
    goal_range: float = 0.15
    """The goal lies at most this far from the grip along each axis."""
    goal_offset: float = 0.0
    """Added to the goal's x."""
    goals_in_air: bool = False
    """Half of the goals lie up to 0.45 above the table."""
    blocks_fingers: bool = True
    """The fingers are set to closed after every step."""
    puck: bool = False
    """The object is a cylinder with little friction, on a longer table; otherwise a cube with edges of 5 cm."""
    solver_steps: int = 4
    """Newton steps a physics step that the task's contacts need: with two grasps fail, with four a puck gains energy in
    every bounce."""
    base_x: float = 0.405
    """Where the robot's base stands, x of the first slide joint."""

    @property
    def reference(self) -> str:
        """What Gymnasium-Robotics calls the task: FetchReach-v4."""
        return f"{self.name.title().replace('_', '')}-v4"


TASKS = {
    task.name: task
    for task in (
        Task(
            "fetch_reach", ABOVE_TABLE_BLOCKED, (1.341835018, 0.749101037, 0.534723951), solver_steps=3, base_x=0.4049
        ),
        Task("fetch_push", ON_TABLE, (1.345540634, 0.749024337, 0.413616705), object_height=0.42470209, solver_steps=6),
        Task(
            "fetch_pick_and_place",
            ABOVE_TABLE,
            (1.341935017, 0.749101052, 0.534723958),
            object_height=0.42470209,
            goals_in_air=True,
            blocks_fingers=False,
        ),
        Task(
            "fetch_slide",
            ON_LONG_TABLE,
            (0.992730445, 0.749040778, 0.41266144),
            object_height=0.413538103,
            start_height=0.4199,
            solver_steps=10,
            object_range=0.1,
            goal_range=0.3,
            goal_offset=0.4,
            puck=True,
            base_x=0.05,
        ),
    )
}


def find(name: str) -> Task:
    """The Fetch task of this name, or a `UserError` with the nearest one."""
    require_known("task", name, TASKS, "no such Fetch task")
    return TASKS[name]


@dataclasses.dataclass(frozen=True)
class FetchConfig:
    """How a Fetch task is simulated and when an episode ends."""

    faithful: bool = False
    """20 physics steps of 2 ms and the whole body, as the reference has them; otherwise 8 steps of 5 ms without what
    seldom matters (docs/reference/fetch.md)."""
    episode_length: Size = 50
    """Steps of 40 ms after which an episode is truncated."""
    ends_at_goal: bool = True
    """Reaching the goal ends the episode (Eq. 5 of the paper); otherwise it goes on to its full length, as in the
    reference."""

    goals: Literal["positions", "images"] = "positions"
    """What a goal is: a position (m), as in the reference, or an image of the object or gripper there, out of a finite
    set, as in the paper. What is achieved is then a goal of a grid, of which some lie 1 to 2 cm from every test goal:
    under `known_goals` held_out the images of test goals alone stay out of training."""
    held_out: Literal["nothing", "octant"] = "nothing"
    """Positions that are never desired in training: `octant`: those ahead, to the left and above the middle of all, a
    quarter of Push's and Slide's, which have one height; test goals lie there."""
    goal_images: str = ""
    """File of goal images, of `infogoal reproduce goal-images`; empty: the one that the project ships for the task."""
    backgrounds: str = ""
    """Backgrounds that goal images are corrupted with: `cifar10`, or a folder; empty: the crops of photographs that the
    project ships."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        require(
            self.goals == "positions" or config is None or config.known_goals != "train",
            "known_goals",
            "train",
            "what is achieved counts as a goal of the grid, and none of those is a training goal: give visited, "
            "held_out or all",
        )
        require(
            self.ends_at_goal or self.goals == "positions",
            "env.ends_at_goal",
            self.ends_at_goal,
            "an image goal counts as reached when its episode ends there: give True, or goals = positions",
        )
        require(
            self.held_out == "nothing" or self.goals == "positions",
            "env.held_out",
            self.held_out,
            "goal images have validation and test goals of their own: give nothing, or goals = positions",
        )
        for name in ("goal_images", "backgrounds"):
            given = getattr(self, name)
            positions = "goals are positions: leave it out, or give --env.goals images"
            require(not given or self.goals == "images", f"env.{name}", given, positions)


@dataclasses.dataclass(frozen=True)
class TargetsConfig:
    """The target states of a Fetch task, on which a low level of HRAC is trained."""

    faithful: bool = False
    """Simulate as finely as the reference does (docs/reference/fetch.md)."""
    episode_length: Size = 50
    """Steps of 40 ms in an episode, always run to its end."""
    moving_share: Share = 0.5
    """Share of the training episodes with a moving target, as the high level will give it [M]."""
