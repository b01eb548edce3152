"""Floor plans for the robot: a small TOML file, and its contents as prisms.

Places are ``[x, y]`` on the floor in m. Everything is a :class:`Prism`: walls with doors cut out of
them, boxes, and poles.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from motionstereo_cli.errors import InputError, SettingsError, words_of
from motionstereo_cli.files.reading import read_bytes
from motionstereo_cli.files.records import in_words
from motionstereo_cli.params import near_match

#: Folder of the plans that come with the program.
_HOME = Path(__file__).parent / "worlds"
_MAX_BYTES = 1_000_000
#: A plan has at most so many prisms: each is rendered in each view.
_MAX_PRISMS = 2000

_POLE_SIDES = 6

Coordinate = Annotated[float, Meta(ge=-1000, le=1000)]
Place = tuple[Coordinate, Coordinate]
Length = Annotated[float, Meta(gt=0, le=1000)]
Height = Annotated[float, Meta(ge=0, le=20)]
Paint = Literal["doors", "cards", "plain", "dark"]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the file."""


class Robot(_Table, frozen=True):
    """The robot, and what it aims at.

    Attributes:
        start: where it starts.
        heading_deg: its first heading, counter-clockwise from the x axis.
        goal: where it is to arrive; without one it explores.
        speed_m_s: its maximum speed.
        latency_frames: after so many frames it does what it was told.
        drift: standard deviation of the errors of its own motion, as a share of each step.
        frames: the drive ends after so many.
    """

    start: Place
    heading_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    goal: Place | None = None
    speed_m_s: Annotated[float, Meta(gt=0, le=10)] = 1.6
    latency_frames: Annotated[int, Meta(ge=0, le=100)] = 0
    drift: Annotated[float, Meta(ge=0, le=1)] = 0.0
    frames: Annotated[int, Meta(ge=1, le=1_000_000)] = 200


class Wall(_Table, frozen=True):
    """A wall along a line; ``closed``: the last point is joined to the first."""

    points: Annotated[list[Place], Meta(min_length=2)]
    closed: bool = False
    height_m: Height = 0.0
    thickness_m: Annotated[float, Meta(ge=0.02, le=10)] = 0.1
    paint: Paint = "doors"


class Door(_Table, frozen=True):
    """A doorway, cut out of the wall that ``at`` lies in."""

    at: Place
    width_m: Length
    height_m: Length = 2.05


class StandingBox(_Table, frozen=True):
    """A box about the place ``at``; ``size``: along x and y before it is turned."""

    at: Place
    size: tuple[Length, Length]
    height_m: Height = 0.0
    bottom_m: Height = 0.0
    turned_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    paint: Paint = "cards"


class Pole(_Table, frozen=True):
    """Poles of one kind at places."""

    at: Annotated[list[Place], Meta(min_length=1)]
    diameter_m: Annotated[float, Meta(ge=0.01, le=10)] = 0.06
    height_m: Height = 0.0
    paint: Paint = "dark"


class FloorPlan(_Table, frozen=True):
    """The file. What has no ``height_m``, or 0, reaches up to the ceiling."""

    about: str
    robot: Robot
    ceiling_m: Annotated[float, Meta(ge=1.5, le=20)] = 2.6
    walls: list[Wall] = []
    doors: list[Door] = []
    boxes: list[StandingBox] = []
    poles: list[Pole] = []


class Prism(NamedTuple):
    """Something that stands.

    Attributes:
        name: its place in the file, such as ``boxes[2]``.
        corners_m: (n, 2) its outline on the floor, counter-clockwise; convex.
        bottom_m, top_m: its height.
        paint: how its sides look.
    """

    name: str
    corners_m: NDArray[np.float64]
    bottom_m: float
    top_m: float
    paint: Paint


def plan_names() -> list[str]:
    """Return the names of the plans that come with the program."""
    return sorted(path.stem for path in _HOME.glob("*.toml"))


def read_plan(world: str) -> FloorPlan:
    """Return a floor plan.

    Args:
        world: name of one that comes with the program, or path of a TOML file.

    Raises:
        SettingsError: there is no such name.
        InputError: the file cannot be read, or is no floor plan.
    """
    names = plan_names()
    if world in names:
        path = _HOME / f"{world}.toml"
    elif Path(world).suffix:
        path = Path(world)
    else:
        raise SettingsError(
            f"--world cannot be {world!r}{near_match(world, names)}: give corridor, a TOML file, "
            f"or one of {', '.join(names)}"
        )
    try:
        values = tomllib.loads(read_bytes(path, "the floor plan", _MAX_BYTES).decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(f"{path} cannot be read as TOML: it is not text in UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as TOML: {_lowered(words_of(error))}") from None
    if not values:
        raise InputError(f"{path} is empty: give about, [robot] with start, and what stands")
    try:
        _check_keys(values, FloorPlan)
        _check_finite(values)
        plan = msgspec.convert(values, FloorPlan)
        prisms(plan)
    except msgspec.ValidationError as error:
        choices = f": choose from {', '.join(get_args(Paint))}" if "enum" in str(error) else ""
        raise InputError(f"{path}: {in_words(error, 'the plan')}{choices}") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return plan


def _check_keys(values: dict[str, Any], kind: type[_Table], place: str = "") -> None:
    """Check that a table and those in it have known keys only.

    Raises:
        ValueError: a key is unknown; the message names its place.
    """
    types = get_type_hints(kind)
    for key, value in values.items():
        if key not in types:
            hint = near_match(key, types) or f": choose from {', '.join(types)}"
            raise ValueError(f"{place}{key} is unknown{hint}")
        of, tables = types[key], value if isinstance(value, list) else [value]
        of = get_args(of)[0] if get_origin(of) is list else of
        for number, table in enumerate(tables):
            if isinstance(of, type) and issubclass(of, _Table) and isinstance(table, dict):
                _check_keys(table, of, f"{key}[{number}]." if tables is value else f"{key}.")


def _check_finite(value: object, place: str = "") -> None:
    """Check that all numbers in a value of TOML are finite.

    Raises:
        ValueError: one is not; the message names its place.
    """
    if isinstance(value, dict):
        for key, each in value.items():
            _check_finite(each, f"{place}.{key}" if place else key)
    elif isinstance(value, list):
        for number, each in enumerate(value):
            _check_finite(each, f"{place}[{number}]")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{place}: {value} is no place, length or angle: give a finite number")


def _lowered(text: str) -> str:
    return text[:1].lower() + text[1:]


def prisms(plan: FloorPlan) -> list[Prism]:
    """Return all that stands in a plan.

    Raises:
        ValueError: its parts contradict one another; the message names the place.
    """
    made = [*_walls(plan), *_boxes(plan), *_poles(plan)]
    if not made:
        raise ValueError("nothing stands in it: give [[walls]], [[boxes]] or [[poles]]")
    if len(made) > _MAX_PRISMS:
        raise ValueError(f"{len(made)} pieces stand in it: give at most {_MAX_PRISMS}")
    return made


def _walls(plan: FloorPlan) -> Iterator[Prism]:
    cut = [False] * len(plan.doors)
    for number, wall in enumerate(plan.walls):
        name, top_m = f"walls[{number}]", wall.height_m or plan.ceiling_m
        ends = [*wall.points, wall.points[0]] if wall.closed else wall.points
        for start, stop in pairwise(np.array(ends, float)):
            length_m = float(np.hypot(*(stop - start)))
            if length_m < wall.thickness_m:
                raise ValueError(f"{name}.points: two follow one another within its thickness")
            ahead = (stop - start) / length_m
            aside = np.array([-ahead[1], ahead[0]]) * wall.thickness_m / 2

            def piece(
                span: tuple[float, float],
                bottom_m: float = 0.0,
                *,
                of: tuple[NDArray[np.float64], ...] = (start, ahead, aside),
                name: str = name,
                top_m: float = top_m,
                paint: Paint = wall.paint,
            ) -> Prism:
                origin, along, left = of
                near, far = (origin + along * m for m in span)
                corners = np.array([near - left, far - left, far + left, near + left])
                return Prism(name, corners, bottom_m, top_m, paint)

            # Pieces overlap at corners by half a thickness, so that none is open.
            begin_m, openings = -wall.thickness_m / 2, []
            for index, door in enumerate(plan.doors):
                off = np.array(door.at) - start
                along_m, aside_m = float(off @ ahead), float(abs(off @ aside)) * 2
                if aside_m <= wall.thickness_m**2 * 1.01 and 0 <= along_m <= length_m:
                    half_m = door.width_m / 2
                    if along_m < half_m or along_m + half_m > length_m:
                        raise ValueError(f"doors[{index}].width_m: the wall at it is shorter")
                    if door.height_m > top_m:
                        raise ValueError(f"doors[{index}].height_m: the wall at it is lower")
                    openings.append((along_m - half_m, along_m + half_m, door.height_m, index))
                    cut[index] = True
            for first_m, last_m, door_m, index in sorted(openings):
                if first_m < begin_m:
                    raise ValueError(f"doors[{index}].at: it overlaps another door")
                yield piece((begin_m, first_m))
                if door_m < top_m:
                    yield piece((first_m, last_m), door_m)
                begin_m = last_m
            yield piece((begin_m, length_m + wall.thickness_m / 2))
    if not all(cut):
        raise ValueError(f"doors[{cut.index(False)}].at: there is no wall")


def _boxes(plan: FloorPlan) -> Iterator[Prism]:
    for number, box in enumerate(plan.boxes):
        name, top_m = f"boxes[{number}]", box.height_m or plan.ceiling_m
        if box.bottom_m >= top_m:
            raise ValueError(f"{name}.bottom_m is not below its top: give less than {top_m:g}")
        if box.bottom_m >= plan.ceiling_m:
            raise ValueError(f"{name}.bottom_m is not below the ceiling at {plan.ceiling_m:g} m")
        turn = math.radians(box.turned_deg)
        across = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        off = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(box.size) / 2
        yield Prism(name, box.at + off @ across, box.bottom_m, top_m, box.paint)


def _poles(plan: FloorPlan) -> Iterator[Prism]:
    turn = np.arange(_POLE_SIDES) * (math.tau / _POLE_SIDES)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    for number, pole in enumerate(plan.poles):
        top_m = pole.height_m or plan.ceiling_m
        for at in pole.at:
            corners = at + circle * pole.diameter_m / 2
            yield Prism(f"poles[{number}]", corners, 0.0, top_m, pole.paint)
