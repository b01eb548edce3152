"""Mapping: from depth to points in space, and from many frames to one map.

It is outside the pipeline because the processing does not depend on the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray  # the path is restored by its type

from motionstereo_cli.robot.fused_map import (
    FREE,
    OCCUPIED,
    Grid,
    Voxels,
    known_free,
    marked,
    merged,
    seen_often,
    trimmed,
    voxels_of,
)
from motionstereo_cli.robot.grid import sighted
from motionstereo_cli.robot.guide import view_of
from motionstereo_cli.robot.local_map import nearest_by_bearing
from motionstereo_cli.robot.points import in_world, points

if TYPE_CHECKING:
    from motionstereo_cli.method.settings import Settings
    from motionstereo_cli.types import Grey, Pose, Real, Rig, Step

    Points = NDArray[np.float64]

#: Error of disparity, and the largest relative error of distance from it: farther points do not
#: enter the map.
_ERROR_PX = 0.25
_ERROR_M = 0.16
#: Nor do points farther than this many cells.
_MAX_CELLS = 400

_BEARINGS = 80

#: A frame sees something stand up from the ground in a cell where at least so many of its points
#: lie in two or more layers of this height.
_STANDING_POINTS, _LAYER_M, _LAYERS = 4, 0.15, 64

#: What moves by itself is found in parts: so far around them it may be, in px.
_AROUND_PX = 12

#: New voxels are collected up to this number, so that the large cloud is merged rarely.
_RECENT = 30_000

#: The path has fewer places: every second one is dropped when it gets longer.
_MAX_PATH = 4096


def camera_points(
    depth_m: Real, view: Grey, which: NDArray[np.bool_], camera: str, rig: Rig
) -> tuple[Points, Grey]:
    """Return the points of a frame in a camera's optical frame, with their grey.

    Args:
        depth_m: depth in the camera's view, (height, width) float32, NaN = unknown.
        view: the camera's image, (height, width) uint8.
        which: pixels to return, (height, width) bool; those of unknown depth are left out.
        camera: ``right`` or ``left``.
        rig: both cameras.

    Returns:
        (n, 3) float64 m, x right, y down, z forward; (n,) uint8.
    """
    which = which & ~np.isnan(depth_m)
    found = points(
        depth_m,
        which,
        focal_px=(rig.focal_px, rig.fy_px),
        cx_px=rig.cx_of(camera),
        cy_px=rig.cy,
    )
    return found, view[which]


def apart_from(
    found: tuple[Points, Grey], moved: NDArray[np.bool_], camera: str, rig: Rig
) -> tuple[Points, Grey]:
    """Return the points of a frame, as :func:`camera_points` gives them, away from some pixels.

    Args:
        found: the points and their grey.
        moved: where something moved by itself, (height, width) bool: parts of it.
        camera, rig: as for the points.
    """
    places, look = found
    around = np.ones((2 * _AROUND_PX + 1,) * 2, np.uint8)
    near = np.asarray(cv2.dilate(moved.view(np.uint8), around)).view(np.bool_)
    x, y, z = places.T
    column = np.rint(x / z * rig.focal_px + rig.cx_of(camera)).astype(np.intp)
    row = np.rint(y / z * rig.fy_px + rig.cy).astype(np.intp)
    apart = ~near[row, column]
    return places[apart], look[apart]


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The state of a map.

    Attributes:
        grid: the floor plane.
        cloud: voxels seen so far, except those in ``recent``.
        recent: voxels of the last frames.
        heights_m: range of z in the world that was in the robot's way in every frame.
        path_m: where the rig was, (n, 2) float64, x and y in the world in m.
        spacing_m: least distance between two of these places.
    """

    grid: Grid
    cloud: Voxels
    recent: Voxels
    heights_m: tuple[float, float]
    path_m: NDArray[np.float64]
    spacing_m: float


@dataclass(frozen=True, slots=True)
class Floor:
    """The floor plane from above.

    Attributes:
        occupied, free: (nx, ny) bool, axis 0 along the world's x, axis 1 along its y; a cell that
            is neither is unknown.
        x_m, y_m: place of the outer corner of ``occupied[0, 0]`` in the world.
        cell_m: size of a cell.
    """

    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]
    x_m: float
    y_m: float
    cell_m: float


class Mapper:
    """Fuses the fresh points of frames into one map in the world frame of the poses.

    Args:
        settings: parameters of the processing: what counts as an obstacle.
        rig: the camera.
        cell_m: size of the cells of the floor plane and of the voxels.

    Attributes:
        known: the map, None before the first frame.
    """

    def __init__(self, settings: Settings, rig: Rig, cell_m: float) -> None:
        self._settings = settings
        self._rig = rig
        self._cell_m = cell_m
        # Z = f B / d, so an error of d makes one of Z^2 / (f B) times as much in Z.
        reach_m = math.sqrt(_ERROR_M * rig.focal_baseline / _ERROR_PX)
        self._reach_m = min(reach_m, _MAX_CELLS * cell_m)
        self.known: Surroundings | None = None

    def see(self, step: Step) -> None:
        """Add a frame, unless the rig is lost there or nothing is known of its points."""
        if step.points is not None and step.place is not None:
            self.add(*step.points, step.place)

    def add(self, seen: Points, grey: Grey, pose: Pose) -> None:
        """Add the fresh points of a frame.

        Args:
            seen, grey: its points, as :func:`camera_points` gives them.
            pose: the pose of the rig.
        """
        s = self._settings
        known = self.known or self._nothing(pose)
        placed = in_world(
            seen,
            camera_left_m=self._rig.left_of_middle_m(s.reference),
            place_m=(pose.x_m, pose.y_m, pose.z_m),
            quaternion=(pose.qx, pose.qy, pose.qz, pose.qw),
        )
        near = seen[:, 2] <= self._reach_m
        recent = merged(
            known.recent, voxels_of(placed[near] / self._cell_m, grey[near], known.cloud.origin)
        )
        low_m, high_m = known.heights_m
        known = Surroundings(
            grid=self._marked(known.grid, placed, pose),
            cloud=known.cloud,
            recent=recent,
            path_m=known.path_m,
            spacing_m=known.spacing_m,
            heights_m=(
                max(low_m, pose.z_m - s.robot_below_m),
                min(high_m, pose.z_m + s.robot_above_m),
            ),
        )
        known = _went_on(known, pose)
        self.known = _settled(known) if len(recent.key) > _RECENT else known

    def floor(self) -> Floor:
        """Return the known part of the floor plane: at least one cell."""
        grid = trimmed(Grid.empty() if self.known is None else self.known.grid)
        x_m, y_m = (corner * self._cell_m for corner in grid.corner)
        return Floor(grid.evidence >= OCCUPIED, grid.evidence <= FREE, x_m, y_m, self._cell_m)

    @property
    def path_m(self) -> Points:
        """Where the rig was, (n, 2) float64: x and y in the world in m."""
        return np.zeros((0, 2)) if self.known is None else self.known.path_m

    def points(self, top_m: float = math.inf) -> tuple[Points, Grey]:
        """Return the cloud, one point a voxel: (n, 3) float64 m in the world, (n,) uint8 grey.

        Points seen in only a few frames are left out, and so are those in the robot's way where the
        floor plane is free: they have moved away.

        Args:
            top_m: points this far or farther above the cameras, where they were lowest, are left
                out.
        """
        if self.known is None:
            return np.zeros((0, 3)), np.zeros(0, np.uint8)
        self.known = _settled(self.known)
        places, grey = seen_often(self.known.cloud)
        height_m = places[:, 2] * self._cell_m
        low_m, high_m = self.known.heights_m
        stays = ~(
            (low_m < height_m) & (height_m < high_m) & known_free(self.known.grid, places[:, :2])
        )
        stays &= height_m < high_m - self._settings.robot_above_m + top_m
        return places[stays] * self._cell_m, grey[stays]

    def _nothing(self, pose: Pose) -> Surroundings:
        place = (pose.x_m, pose.y_m, pose.z_m)
        x, y, z = (math.floor(each / self._cell_m) for each in place)
        none = Voxels.empty((x, y, z))
        heights_m = -math.inf, math.inf
        return Surroundings(
            Grid.empty(), none, none, heights_m, np.array([place[:2]]), self._cell_m
        )

    def _marked(self, grid: Grid, placed: Points, pose: Pose) -> Grid:
        """Return the grid with a frame's points, which are in the world frame.

        They are projected as for a level camera, so that tilt does not matter.
        """
        s, rig, cell_m, yaw = self._settings, self._rig, self._cell_m, pose.yaw_rad
        cos, sin = math.cos(yaw), math.sin(yaw)
        view = view_of(rig, s.reference, rig.camera_on_floor(pose, s.reference), yaw)
        x, y, up = (placed - (view.x_m, view.y_m, pose.z_m)).T
        ahead, leftward = cos * x + sin * y, cos * y - sin * x
        in_way = (up > -s.robot_below_m) & (up < s.robot_above_m) & (ahead > 0)
        near = in_way & (ahead <= self._reach_m)
        ahead, leftward = ahead[in_way], leftward[in_way]
        column = view.cx_px - view.focal_px * leftward / ahead
        bearing = np.floor((column + 0.5) * _BEARINGS / rig.width)
        inside = (bearing >= 0) & (bearing < _BEARINGS)
        near_px = nearest_by_bearing(
            (view.focal_baseline / ahead[inside]).astype(np.float32),
            bearing[inside].astype(np.intp),
            _BEARINGS,
        )
        widest = max(view.cx_px, rig.width - view.cx_px) / view.focal_px
        half = math.ceil(self._reach_m * math.hypot(1, widest) / cell_m)
        corner = math.floor(view.x_m / cell_m) - half, math.floor(view.y_m / cell_m) - half
        sight = sighted(
            (2 * half, 2 * half),
            corner,
            near_px,
            view,
            rig.width,
            cell_m=cell_m,
            reach_m=self._reach_m,
            error_px=_ERROR_PX,
        )
        stands = standing(placed[near], up[near] + s.robot_below_m, corner, sight.hit.shape, cell_m)
        return marked(grid, corner, sight.free & ~stands, sight.hit | stands)


def standing(
    placed: Points,
    up_m: NDArray[np.float64],
    corner: tuple[int, int],
    shape: tuple[int, ...],
    cell_m: float,
) -> NDArray[np.bool_]:
    """Return in which cells of a grid points stand up from the ground.

    Args:
        placed: points in the world, (n, 3) float64 m.
        up_m: their heights over what counts as no obstacle, (n,) m.
        corner: world cell of the grid's first one.
        shape: number of cells along x and y.
        cell_m: size of a cell.
    """
    index = np.floor(placed[:, :2] / cell_m).astype(np.int64) - corner
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    cell = index[inside] @ (shape[1], 1)
    size = shape[0] * shape[1]
    layer = np.minimum(up_m[inside] / _LAYER_M, _LAYERS - 1).astype(np.int64)
    layers = np.bincount(np.unique(cell * _LAYERS + layer) // _LAYERS, minlength=size)
    found = (layers >= 2) & (np.bincount(cell, minlength=size) >= _STANDING_POINTS)
    return found.reshape(shape)


def _went_on(known: Surroundings, pose: Pose) -> Surroundings:
    """Return the map with the place of the rig, if it is away from the last one."""
    path_m, spacing_m, place = known.path_m, known.spacing_m, np.array([pose.x_m, pose.y_m])
    if np.hypot(*(place - path_m[-1])) < spacing_m:
        return known
    path_m = np.vstack([path_m, place])
    if len(path_m) == _MAX_PATH:
        path_m, spacing_m = path_m[::2], 2 * spacing_m
    return replace(known, path_m=path_m, spacing_m=spacing_m)


def _settled(known: Surroundings) -> Surroundings:
    """Return the map with recent voxels merged into the cloud."""
    return replace(
        known,
        cloud=merged(known.cloud, known.recent),
        recent=Voxels.empty(known.cloud.origin),
    )
