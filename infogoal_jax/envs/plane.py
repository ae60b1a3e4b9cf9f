"""Tasks in the plane without a simulator, for a first try, for notebooks and for tests: a point in a maze of rooms, and
an arm of two joints. Goals are continuous, and some lie where training never asks for one."""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.envs.goal_task import Episode, GoalTask, GoalTaskConfig
from infogoal_jax.envs.recordings import recorded_in
from infogoal_jax.field_types import Size, Within
from infogoal_jax.goals import GoalBox

ROOMS = 3
"""Rooms along each side of the maze; each is a square with sides of 1."""
DOORS = {"vertical": ((1, 0, 1), (1, 1, 0)), "horizontal": ((1, 1, 0), (1, 0, 1))}
"""1 where a wall has a door. vertical: the walls at x = 1 and 2, for each row of rooms from below; horizontal: those at
y = 1 and 2, for each column."""
DOOR = 0.25
"""Half of the width of a door."""
PIXELS = 120
"""Along each side of a picture."""
FLOOR, WALL, BODY, GOAL = (255, 255, 255), (90, 90, 90), (0, 114, 178), (0, 158, 115)
"""Colours of a picture: red, green and blue."""
TEST_ROOMS, VALIDATION_ROOMS = ((2, 0), (0, 2)), ((2, 2),)
"""Column and row of rooms that no training goal lies in."""


@dataclasses.dataclass(frozen=True)
class PlaneConfig(GoalTaskConfig):
    """Sizes of a task in the plane."""

    episode_length: Size = 100
    """Steps of an episode."""
    radius: Annotated[float, Within("(0, 1)", "give a distance above 0 and below 1")] = 0.15
    """Distance below which a goal is reached; rooms, and the parts of the arm, are 1 long."""
    held_out: bool = True
    """Whether parts of the plane are never desired in training; test goals lie there."""


def use_of_place(goal: jax.Array) -> jax.Array:
    """The use of a goal of the maze, by its room: int32, a position in `goal_uses.USES`."""
    room = jnp.floor(goal).astype(jnp.int32)

    def lies_in(rooms):
        return jnp.stack([(room == jnp.array(each, jnp.int32)).all() for each in rooms]).any()

    return jnp.where(lies_in(TEST_ROOMS), 2, jnp.where(lies_in(VALIDATION_ROOMS), 1, 0)).astype(jnp.int32)


def pixels_of(low: float, high: float) -> jax.Array:
    """The places float32 [P, P, 2] of the pixels of a square picture; y grows upwards."""
    along = low + (high - low) * (jnp.arange(PIXELS, dtype=jnp.float32) + 0.5) / PIXELS
    return jnp.stack(jnp.meshgrid(along, along[::-1]), axis=-1)


def paint(*layers: tuple[jax.Array, tuple[int, int, int]]) -> jax.Array:
    """A picture uint8 [P, P, 3] of these masks bool [P, P] and their colours, the last on top."""
    picture = jnp.full((PIXELS, PIXELS, 3), jnp.array(FLOOR, jnp.uint8))
    for mask, colour in layers:
        picture = jnp.where(mask[..., None], jnp.array(colour, jnp.uint8), picture)
    return picture


def is_near(pixels: jax.Array, place: jax.Array, radius: float) -> jax.Array:
    """Which pixels lie in a circle, bool [P, P]."""
    return jnp.linalg.norm(pixels - place, axis=-1) < radius


@flax.struct.dataclass
class PointMaze(GoalTask):
    """A point moves up to 0.1 a step along each axis through rooms with walls and doors. Its world is its place [2]."""

    action_size = 2
    source: str = flax.struct.field(pytree_node=False, default="a maze of 3 x 3 rooms, simulated", kw_only=True)
    """What is simulated, in words."""

    def begin(self, key: jax.Array) -> jax.Array:
        """Anywhere, but away from the walls."""
        room_key, place_key = jax.random.split(key)
        room = jax.random.randint(room_key, (2,), 0, ROOMS, jnp.int32).astype(jnp.float32)
        return room + jax.random.uniform(place_key, (2,), jnp.float32, 0.1, 0.9)

    def move(self, place: jax.Array, action: jax.Array) -> jax.Array:
        """Along x, then along y; a wall without a door there stops the point."""
        for axis, walls in enumerate((DOORS["vertical"], DOORS["horizontal"])):
            there = place.at[axis].add(0.1 * action[axis])
            across = place[1 - axis]
            row = jnp.clip(jnp.floor(across).astype(jnp.int32), 0, ROOMS - 1)
            at_door = jnp.abs(across - row.astype(jnp.float32) - 0.5) < DOOR
            number = jnp.floor(jnp.maximum(place[axis], there[axis])).astype(jnp.int32)  # Of the wall on the way.
            crosses = jnp.floor(place[axis]) != jnp.floor(there[axis])
            inner = (number > 0) & (number < ROOMS)
            is_open = jnp.array(walls, bool)[jnp.clip(number - 1, 0, ROOMS - 2), row] & at_door & inner
            place = jnp.where(crosses & ~is_open, place, there)
        return jnp.clip(place, 0.01, ROOMS - 0.01)

    def observation(self, place: jax.Array) -> jax.Array:
        """The place, from -1 to 1."""
        return place / (ROOMS / 2) - 1.0

    def achieved_in(self, observation: jax.Array) -> jax.Array:
        return (observation + 1.0) * (ROOMS / 2)

    def achieved_goal(self, place: jax.Array) -> jax.Array:
        return place

    def draw(self, state: Episode) -> jax.Array:
        """The maze from above, uint8 [P, P, 3]: walls, the desired goal with its radius, and the point."""
        pixels, walls = pixels_of(0.0, float(ROOMS)), jnp.zeros((PIXELS, PIXELS), bool)
        for axis, doors in enumerate((DOORS["vertical"], DOORS["horizontal"])):
            across = pixels[..., 1 - axis]
            row = jnp.floor(across).astype(jnp.int32)
            at_door = jnp.abs(across - row.astype(jnp.float32) - 0.5) < DOOR
            for number, has_door in enumerate(doors, 1):
                is_open = jnp.array(has_door, bool)[row] & at_door
                walls |= (jnp.abs(pixels[..., axis] - number) < 0.03) & ~is_open
        goal, point = is_near(pixels, state.desired_goal, self.radius), is_near(pixels, state.world, 0.07)
        return paint((walls, WALL), (goal, GOAL), (point, BODY))


def draw_in_reach(key: jax.Array) -> jax.Array:
    """A goal of the arm [2]: anywhere that it can reach without folding up."""
    distance_key, angle_key = jax.random.split(key)
    distance = jnp.sqrt(jax.random.uniform(distance_key, (), jnp.float32, 0.5**2, 1.9**2))
    angle = jax.random.uniform(angle_key, (), jnp.float32, -jnp.pi, jnp.pi)
    return distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def use_of_quarter(goal: jax.Array) -> jax.Array:
    """The use of a goal of the arm: test goals lie ahead to the left, validation goals ahead to the right."""
    return jnp.where(goal[0] > 0, jnp.where(goal[1] > 0, 2, 1), 0).astype(jnp.int32)


@flax.struct.dataclass
class Reacher(GoalTask):
    """An arm of two joints turns each by up to 0.2 radians a step, to bring its tip to a place. Its world are the two
    angles."""

    action_size = 2
    source: str = flax.struct.field(pytree_node=False, default="an arm of two joints, simulated", kw_only=True)
    """What is simulated, in words."""

    def begin(self, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (2,), jnp.float32, -jnp.pi, jnp.pi)

    def move(self, angles: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.mod(angles + 0.2 * action + jnp.pi, 2 * jnp.pi) - jnp.pi

    def observation(self, angles: jax.Array) -> jax.Array:
        """Sines and cosines of the angles, and the tip."""
        return jnp.concatenate([jnp.sin(angles), jnp.cos(angles), self.achieved_goal(angles) / 2])

    def achieved_in(self, observation: jax.Array) -> jax.Array:
        return 2 * observation[4:]

    def achieved_goal(self, angles: jax.Array) -> jax.Array:
        """The place of the tip, [2]."""
        first, second = angles[0], angles[0] + angles[1]
        return jnp.stack([jnp.cos(first) + jnp.cos(second), jnp.sin(first) + jnp.sin(second)])

    def draw(self, state: Episode) -> jax.Array:
        """The arm from above, uint8 [P, P, 3], and the desired goal with its radius."""
        pixels = pixels_of(-2.2, 2.2)
        elbow = jnp.stack([jnp.cos(state.world[0]), jnp.sin(state.world[0])])
        tip = self.achieved_goal(state.world)
        along = jnp.linspace(0.0, 1.0, 21, dtype=jnp.float32)[:, None]
        places = jnp.concatenate([along * elbow, elbow + along * (tip - elbow)])
        arm = jax.vmap(lambda place: is_near(pixels, place, 0.06))(places).any(0)
        return paint((is_near(pixels, state.desired_goal, self.radius), GOAL), (arm, BODY))


def make_maze(config: PlaneConfig) -> PointMaze:
    use_of = use_of_place if config.held_out else None
    goals = GoalBox.of([0.0, 0.0], [float(ROOMS)] * 2, use_of=use_of)
    return recorded_in(PointMaze(goals, config.radius, config.episode_length, config.ends_at_goal), config.dataset)


def make_reacher(config: PlaneConfig) -> Reacher:
    use_of = use_of_quarter if config.held_out else None
    goals = GoalBox.of([-2.0, -2.0], [2.0, 2.0], sampler=draw_in_reach, use_of=use_of)
    return recorded_in(Reacher(goals, config.radius, config.episode_length, config.ends_at_goal), config.dataset)
