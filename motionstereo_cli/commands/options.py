"""Options shared by commands: declared parameters, and the configuration file."""

from __future__ import annotations

import functools
from collections.abc import Callable, Set
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from motionstereo_cli.commands.grouped import GROUPS, GroupedOption
from motionstereo_cli.commands.messages import say
from motionstereo_cli.errors import InputError, SettingsError
from motionstereo_cli.files.reading import read_bytes
from motionstereo_cli.method.settings import PRESETS, Settings
from motionstereo_cli.params import Param, idle, near_match, params
from motionstereo_cli.rig.settings import PoseSettings, RigSettings
from motionstereo_cli.sinks.settings import OutputSettings
from motionstereo_cli.sources.settings import InputSettings


def say_idle(present: Set[str], *groups: Any) -> None:
    """Say which parameters of dataclass instances are given, but have no effect.

    Args:
        present: the options there are, as :func:`~motionstereo_cli.params.idle` takes them.
        groups: the instances.
    """
    for group in groups:
        for line in idle(group, present):
            say("note", line)


def settings_options(
    settings: type, group: str = GROUPS[0], present: Set[str] = frozenset()
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command an option for each parameter of a dataclass, and ``--config``.

    Their heading in the help is ``group``, unless a parameter has its own. Conditions of their
    effect that ``present`` always fulfils are not stated.

    The command receives one ``settings``, made of the values that were given on the command line
    or in the configuration file.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        return config_option(_declared(settings, "settings", group, present)(command))

    return decorate


def _declared(
    settings: type,
    name: str,
    group: str,
    present: Set[str] = frozenset(),
    make: Callable[..., Any] | None = None,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the options of a dataclass; it receives that as ``name``.

    It is made by ``make``, the dataclass itself if None, of the values that were given.
    """
    declared = list(params(settings))

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        def collect(**values: Any) -> Any:
            given = {item.name: values.pop(item.name) for item in declared}
            for item in filter(lambda item: item.old, declared):
                former = values.pop(item.old)
                given[item.name] = former if given[item.name] is None else given[item.name]
            chosen = {key: value for key, value in given.items() if value is not None}
            return command(**{name: (make or settings)(**chosen)}, **values)

        collected: Callable[..., Any] = functools.update_wrapper(collect, command)
        for item in reversed(declared):
            collected = _option(item, group, present)(collected)
            if item.old:
                flag = "--" + item.old.replace("_", "-")
                collected = click.option(flag, item.old, type=item.parse, hidden=True)(collected)
        return collected

    return decorate


def processing_options(
    command: Callable[..., Any], present: Set[str] = frozenset()
) -> Callable[..., Any]:
    """Give a command the options of the processing; it receives them as one ``settings``.

    Conditions of their effect that ``present`` always fulfils are not stated.
    """

    def collect(*, preset: str, chosen: dict[str, Any], **values: Any) -> Any:
        return command(settings=Settings.preset(preset, **chosen), **values)

    collected: Callable[..., Any] = functools.update_wrapper(collect, command)
    collected = _declared(Settings, "chosen", "Method", present, make=dict)(collected)
    return _preset_option(config_option(collected))


def world_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of a driven world; it receives them as one ``world``."""
    from motionstereo_cli.simulate.settings import DriveSettings

    return _declared(DriveSettings, "world", "Scene")(command)


def input_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command LEFT, RIGHT and the options of the input.

    It receives them as ``left`` and ``right``, None if not given, and one ``input_settings``.
    """
    collected = _declared(InputSettings, "input_settings", "Input")(command)
    # Hidden; it takes the file names that a shell makes of patterns without quotes.
    collected = click.argument(
        "more", nargs=-1, metavar="", expose_value=False, callback=_none_more
    )(collected)
    # Text, not paths: as paths, standard input "-" and a file "./-" would be equal.
    collected = click.argument("right", required=False, shell_complete=_files)(collected)
    return click.argument("left", shell_complete=_files)(collected)


def _files(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(incomplete, type="file")]


def _none_more(ctx: click.Context, _: click.Parameter, more: tuple[str, ...]) -> None:
    if more:
        raise click.UsageError(
            f"{2 + len(more)} inputs are too many: give LEFT and RIGHT, "
            "and put patterns such as 'cam0_*.png' in quotes",
            ctx,
        )


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of the output; it receives them as one ``output_settings``."""
    return _declared(OutputSettings, "output_settings", "Output")(command)


def pose_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command ``--poses`` and its options.

    It receives them as ``poses``, None if not given, and one ``pose_settings``.
    """
    collected = _declared(PoseSettings, "pose_settings", "Calibration")(command)
    return click.option(
        "--poses",
        type=click.Path(path_type=Path),
        help="Poses of the rig or auto, for map-based guidance. auto: they are found from the "
        "recording itself. Otherwise a file in TUM format, lines t x y z qx qy qz qw "
        "of the point halfway between the cameras, in s and m; x forward, y left, z up; t as in "
        "the recordings; or EuRoC's or KITTI's format. Needs --rig, or a bag with camera_info.",
    )(collected)


def rig_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command ``--rig`` and its options.

    It receives them as ``rig``, a tuple of paths, empty if not given, and one ``rig_settings``.
    """
    files = click.option(
        "--rig",
        multiple=True,
        type=click.Path(path_type=Path),
        help="Calibration of the cameras; needed for results in m and rad. A rig.yaml, OpenCV, "
        "KITTI, Middlebury, kalibr, ORB-SLAM, DepthAI or ZED file; given twice, left first, for a "
        "pair of files (ROS camera_info, EuRoC sensor.yaml, OpenCV intrinsics and extrinsics). It "
        "also tells how to rectify the images. Left out, the calibration of a bag or in the folder "
        "of image folders is taken (calib.txt, sensor.yaml ...); none: without one.",
    )
    return files(calibration_options(command))


def calibration_options(
    command: Callable[..., Any], present: Set[str] = frozenset()
) -> Callable[..., Any]:
    """Give a command the options of a calibration; it receives them as one ``rig_settings``.

    Conditions of their effect that ``present`` always fulfils are not stated.
    """
    return _declared(RigSettings, "rig_settings", "Calibration", present)(command)


_preset_option = click.option(
    "--preset",
    type=click.Choice(list(PRESETS)),
    metavar="NAME",
    default="default",
    show_default=True,
    help=f"Set of values for the method ({', '.join(PRESETS)}). Other options override it.",
)


class Count(click.IntRange):
    """A whole number within a range, which the help states as it does those of parameters."""

    name = "integer"

    def _describe_range(self) -> str:
        return f"{self.min:,} to {self.max:,}"


def _option(
    item: Param, group: str, present: Set[str]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    # No default here, so that a preset can tell which values were given.
    option = functools.partial(
        click.option,
        cls=GroupedOption,
        group=item.group or group,
        common=item.common,
        help=_help(item, present),
    )
    if item.kind is bool:
        return option(f"{item.flag}/--no-{item.flag.removeprefix('--')}", item.name, default=None)
    kind = {int: "INTEGER", float: "NUMBER", str: "TEXT"}[item.kind]

    def complete(_: click.Context, __: click.Parameter, begun: str) -> list[str]:
        words = dict.fromkeys((*item.choices, *item.more(), *item.words))
        return [word for word in words if word.startswith(begun)]

    return option(
        item.flag,
        item.name,
        type=item.parse,
        metavar=f"[{'|'.join(item.choices)}]" if item.choices and not _many(item) else kind,
        shell_complete=complete,
    )


def _many(item: Param) -> bool:
    """Return whether the choices are too many to stand beside the option's name."""
    return len("|".join(item.choices)) > 24


def _help(item: Param, present: Set[str]) -> str:
    condition = f" Only with {item.only_with}." if item.missing(present) else ""
    default = "on" if item.default is True else "off" if item.default is False else item.default
    if isinstance(default, (int, float)):
        default = f"{default:,.10g}"
    default = f"default: {default}" if default != "" else ""
    facts = [item.unit, item.range if not item.choices or _many(item) else "", default]
    shown = "; ".join(fact for fact in facts if fact)
    return f"{item.help}{condition}" + f"  [{shown}]" * bool(shown)


#: Key in a context's ``meta`` for the file that was read.
_CONFIG = f"{__name__}.config"

#: A configuration has a few hundred lines, and no option takes a larger number.
_MAX_CONFIG_BYTES, _MAX_NUMBER = 1_000_000, 1e18

config_option = click.option(
    "--config",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    is_eager=True,
    expose_value=False,
    callback=lambda ctx, _, path: _read_config(ctx, path) if path else None,
    help="TOML file with values for these options, as NAME = VALUE without the dashes. The command "
    "line wins.",
)


def _is_plain(value: object) -> bool:
    """Return whether an option can have a value of TOML: no date, table, NaN or giant number."""
    if isinstance(value, str):
        return "\0" not in value
    return isinstance(value, int | float) and abs(value) < _MAX_NUMBER  # NaN is not


def config_files() -> tuple[Path, ...]:
    """Return the configuration file that the command at hand read, if it did."""
    found: tuple[Path, ...] = click.get_current_context().meta.get(_CONFIG, ())
    return found


def _default(ctx: click.Context, path: Path, key: str, option: click.Option, value: Any) -> Any:
    """Return a value of a configuration as the option's default."""
    if option.is_flag and not isinstance(value, str):
        if value not in (True, False):  # 1 and 0 are
            raise click.UsageError(f"{path}: {key} cannot be {value!r}: give true or false", ctx)
        return bool(value)
    # Where an option may be repeated, click takes a single text for a list of letters.
    return [value] if option.multiple and isinstance(value, str) else value


def _toml(text: str) -> dict[str, Any]:
    import tomllib  # which takes 3 ms, and few commands have a configuration file

    return tomllib.loads(text)


def _read_config(ctx: click.Context, path: Path) -> None:
    """Make the values of a configuration file the defaults of the command's options."""
    ctx.meta[_CONFIG] = (path,)
    try:
        values = _toml(read_bytes(path, "a configuration", _MAX_CONFIG_BYTES).decode("utf-8-sig"))
    except InputError as error:
        raise click.UsageError(str(error), ctx) from None
    except (ValueError, RecursionError) as error:
        raise click.UsageError(f"{path}: cannot be read as TOML: {error}", ctx) from None
    options = {
        flag.removeprefix("--"): option
        for option in ctx.command.params
        if isinstance(option, click.Option) and option.expose_value
        for flag in option.opts
        if flag.startswith("--")
    }
    defaults = {}
    for key, value in values.items():
        flag = key.replace("_", "-")
        if flag not in options:
            raise click.UsageError(
                f"{path}: unknown key {key[:60]!r}{near_match(flag, options)}", ctx
            )
        option = options[flag]
        if not _is_plain(value) and not (
            option.multiple and isinstance(value, list) and all(map(_is_plain, value))
        ):
            wanted = "text, a finite number, true or false" + ", or a list" * option.multiple
            shown = f"{value!r:.60}" if not isinstance(value, int) else "so large a number"
            raise click.UsageError(f"{path}: {key} cannot be {shown}: give {wanted}", ctx)
        default = _default(ctx, path, key, option, value)
        defaults[option.name] = default
        try:
            option.type_cast_value(ctx, default)
        except click.UsageError as error:
            raise click.UsageError(f"{path}: {error.format_message()}", ctx) from None
        except SettingsError as error:
            raise SettingsError(f"{path}: {error}") from None
        except (TypeError, ValueError, AttributeError):
            raise click.UsageError(f"{path}: {key} cannot be {value!r}: give text", ctx) from None
    ctx.default_map = defaults
