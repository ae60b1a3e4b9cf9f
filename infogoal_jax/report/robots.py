"""Pictures of robots of brax, MuJoCo Playground and Gymnasium, without OpenGL: the geoms of their MuJoCo models where a
state has them, and the goal where the body that achieves it has to be.

The environment's own marks of a goal, bodies and geoms that are called `target` or `goal`, are left out: an episode may
have another goal than the one that the environment drew. So are mocap bodies, which have no joints.
"""

import re
from typing import Any, NamedTuple

import mujoco
import numpy as np

from infogoal_jax.envs.adapters import AdaptedTask
from infogoal_jax.envs.raycast import (
    GOAL,
    GROUND,
    INK,
    REACHED,
    Box,
    Camera,
    Capsule,
    Cylinder,
    Ellipsoid,
    Picture,
    Shape,
    cast,
    cast_marker,
    cast_shadows,
    developed,
    direction,
    empty_picture,
    write_words,
)

OF_A_GOAL = re.compile("target|goal", re.IGNORECASE)
FIRST_HIDDEN_GROUP = 3
"""Groups of geoms from here on are for contacts alone, as MuJoCo's own viewer has it."""
SAME_PLACE = 1e-3
"""Two places are one up to this share of the robot's size."""
ROOM = 1.2
"""Of a new view, around all that moves."""
SMALL = 2.5
"""A view this many times as large as what moves is too large."""
AWAY = 2.8
"""From the camera to the middle of a view, in radii of the view."""
AROUND, ABOVE = -42.0, 30.0
"""Degrees by which the camera is turned around the middle, and looks down."""
LEAST_MARK = 0.03
"""Of a goal's radius, in radii of the view."""


class View(NamedTuple):
    """A sphere that the camera looks at, and the picture of all in it that never moves. Shapes are drawn in units of
    its radius, with the ground at height 0."""

    middle: np.ndarray
    """[3], in the world."""
    radius: float
    origin: np.ndarray
    """[3], the point of the ground below the middle, in the world."""
    camera: Camera
    still: Picture

    def seen(self, place: np.ndarray) -> np.ndarray:
        """Where a place [3] of the world is in the view."""
        return (place - self.origin) / self.radius


class RobotPainter:
    """Draws the states of one task. The camera stands still until what moves leaves its view, or is small in it."""

    def __init__(self, task: AdaptedTask, size: tuple[int, int]):
        self.task, self.size = task, size
        self.model = model = task.mujoco_model()
        self.data = mujoco.MjData(model)
        drawn = [geom for geom in range(model.ngeom) if self.is_drawn(geom)]
        moves = model.body_weldid[model.geom_bodyid] != 0
        self.moving = [geom for geom in drawn if moves[geom]] or np.flatnonzero(moves).tolist()
        self.standing = [geom for geom in drawn if not moves[geom]]
        self.view: View | None = None
        self.achieving: int | None = None
        """Which of `places` achieves the goal; None as long as it is not known."""

    def colour(self, geom: int) -> np.ndarray:
        """Red, green, blue and opacity [4] of a geom: its material's, if it has one."""
        material = self.model.geom_matid[geom]
        return self.model.mat_rgba[material] if material >= 0 else self.model.geom_rgba[geom]

    def is_drawn(self, geom: int) -> bool:
        """Whether a geom can be seen, and is no mark of a goal."""
        model, kind = self.model, mujoco.mjtGeom(self.model.geom_type[geom])
        body = model.geom_bodyid[geom]
        names = model.geom(geom).name, model.body(body).name
        return (
            kind not in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
            and model.geom_group[geom] < FIRST_HIDDEN_GROUP
            and self.colour(geom)[3] > 0
            and model.body_mocapid[body] < 0
            and not any(map(OF_A_GOAL.search, names))
        )

    def __call__(self, state: Any) -> np.ndarray:
        """A picture uint8 [H, W, 3] (RGB) of a state, which says the step and the distance to the goal."""
        self.data.qpos[:] = self.task.joint_positions(state.world)
        mujoco.mj_kinematics(self.model, self.data)
        goal, achieved = np.asarray(state.desired_goal, float), np.asarray(self.task.achieved(state), float)
        place, reached = self.place_of(goal, achieved), bool(self.task.reached(achieved, goal))
        view = self.view = self.view_of(place)
        picture, colour = view.still.copy(), REACHED if reached else GOAL
        shapes = [self.shape(geom, view) for geom in self.moving]
        marks = []
        if place is not None:
            middle = view.seen(place)
            marks = [Capsule(middle, middle, max(self.task.radius / view.radius, LEAST_MARK), colour)]
        cast_shadows(picture, view.camera, shapes + marks, {GROUND: 0.0})
        for shape in shapes:
            cast(picture, view.camera, shape)
        for mark in marks:
            cast_marker(picture, view.camera, mark, 0.5, 0.25)
        frame = developed(picture, view.camera)
        words = f"step {int(state.time)}   {np.linalg.norm(achieved - goal):.3g} to the goal"
        write_words(frame, words + ("   reached" if reached else ""), REACHED if reached else INK)
        return frame

    def places(self) -> np.ndarray:
        """Where bodies, geoms and sites that move are [N, 3]."""
        data, model = self.data, self.model
        bodies = np.concatenate([np.arange(model.nbody), model.geom_bodyid, model.site_bodyid])
        found = np.concatenate([data.xpos, data.geom_xpos, data.site_xpos])
        return found[model.body_weldid[bodies] != 0]

    def place_of(self, goal: np.ndarray, achieved: np.ndarray) -> np.ndarray | None:
        """Where a goal lies [3]: where a body would be that achieves it, which is found by where it is; None for a goal
        that is no place."""
        count = len(goal)
        if count not in (2, 3):
            return None
        places = self.places()
        if self.achieving is None:
            off = np.linalg.norm(places[:, :count] - achieved, axis=1)
            if not len(off) or off.min() > SAME_PLACE * max(self.model.stat.meansize, SAME_PLACE):
                return None
            self.achieving = int(off.argmin())
        return np.concatenate([goal, places[self.achieving, count:]])

    def view_of(self, place: np.ndarray | None) -> View:
        """The view that holds all that moves, and the goal: the last one if it does."""
        middles, radii = self.data.geom_xpos[self.moving], self.model.geom_rbound[self.moving, None]
        goals = [] if place is None else [place - self.task.radius, place + self.task.radius]
        low, high = np.array([*(middles - radii), *goals]).min(0), np.array([*(middles + radii), *goals]).max(0)
        middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        old = self.view
        if old is not None and np.linalg.norm(middle - old.middle) + radius <= old.radius <= SMALL * radius:
            return old
        radius *= ROOM
        origin = np.array([*middle[:2], self.ground(low[2])])
        target = (middle - origin) / radius
        camera = Camera(target + AWAY * direction(AROUND, ABOVE), target, self.size)
        view = View(middle, radius, origin, camera, empty_picture(camera))
        shapes = [self.shape(geom, view) for geom in self.standing]
        cast_shadows(view.still, camera, shapes, {GROUND: 0.0})
        for shape in shapes:
            cast(view.still, camera, shape)
        return view

    def ground(self, lowest: float) -> float:
        """The height of the ground: of a level plane of the model, or below what moves."""
        planes = np.flatnonzero(self.model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))
        heights = [self.data.geom_xpos[plane, 2] for plane in planes if self.data.geom_xmat[plane, 8] > 0.99]
        return float(heights[0]) if heights else float(lowest)

    def shape(self, geom: int, view: View) -> Shape:
        """A geom in a view. A mesh is the box around it."""
        model, kind = self.model, mujoco.mjtGeom(self.model.geom_type[geom])
        turn, size = self.data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom] / view.radius
        middle, colour = view.seen(self.data.geom_xpos[geom]), tuple(self.colour(geom)[:3])
        match kind:
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                return Capsule(middle, middle, size[0], colour)
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                along = size[1] * turn[:, 2]
                return Capsule(middle - along, middle + along, size[0], colour)
            case mujoco.mjtGeom.mjGEOM_CYLINDER:
                return Cylinder(middle, turn, size[0], size[1], colour)
            case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
                return Ellipsoid(middle, turn, size, colour)
            case _:
                offset, half = model.geom_aabb[geom].reshape(2, 3) / view.radius
                return Box(middle + turn @ offset, turn, half, colour)
