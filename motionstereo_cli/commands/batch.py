"""``motionstereo batch``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from motionstereo_cli.commands.grouped import FULL, GroupedCommand
from motionstereo_cli.commands.messages import say
from motionstereo_cli.commands.options import Count
from motionstereo_cli.commands.progress import lines, progress_options
from motionstereo_cli.commands.run import run_options, would_write
from motionstereo_cli.errors import (
    DAMAGED_EXIT_CODE,
    INTERRUPTED_EXIT_CODE,
    MotionStereoError,
    SettingsError,
)
from motionstereo_cli.runs.plan import RunPlan

if TYPE_CHECKING:
    from motionstereo_cli.batch.manifest import ManifestRow
    from motionstereo_cli.sinks.records import Status


#: Options of ``run`` that a batch sets itself.
_NOT_OF_BATCH = ("out", "overwrite", "resume")


@click.command("run")
@run_options
def _plan(**given: Any) -> RunPlan:
    return RunPlan(**given)


def plan_of(arguments: Sequence[str]) -> RunPlan:
    """Return what ``run`` would do with these arguments.

    Raises:
        SettingsError: an option is unknown or out of range, or two contradict each other.
    """
    try:
        with _plan.make_context("run", list(arguments)) as context:
            plan: RunPlan = _plan.invoke(context)
            return plan
    except click.UsageError as error:
        raise SettingsError(error.format_message()) from None


class _BatchCommand(GroupedCommand):
    """A command whose full help, and the shell, also know the options of ``run``."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options and, in the full help, the names of those of ``run``."""
        super().format_options(ctx, formatter)
        if not ctx.meta.get(FULL, False):
            return
        names = [option.opts[-1] for option in self._of_run()]
        with formatter.section("Options of run"):
            formatter.write_dl([("run --help-all", f"explains them: {', '.join(names)}.")])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete options: its own, and those of ``run``."""
        found = super().shell_complete(ctx, incomplete)
        if incomplete.startswith("-"):
            known = {item.value for item in found}
            found += [
                CompletionItem(name, help=option.help)
                for option in self._of_run()
                for name in (*option.opts, *option.secondary_opts)
                if name.startswith(incomplete) and name not in known
            ]
        return found

    def _of_run(self) -> list[click.Option]:
        own = {name for each in self.params for name in each.opts}
        options = [each for each in _plan.params if isinstance(each, click.Option)]
        return [
            each
            for each in options
            if own.isdisjoint(each.opts) and not each.hidden and each.name not in _NOT_OF_BATCH
        ]


@click.command(
    cls=_BatchCommand,
    examples=(
        "motionstereo batch recordings.csv -o results",
        "motionstereo batch 'archive/*/left.mp4' 'archive/*/right.mp4' -o archived",
    ),
    context_settings={"ignore_unknown_options": True},
    options_metavar="MANIFEST [OPTIONS] [OPTIONS OF RUN]",
)
@progress_options
@click.option(
    "-o",
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default="motionstereo_batch",
    show_default=True,
    help="Output folder: one folder for each recording, and the table batch.csv.",
)
@click.option(
    "--workers",
    type=Count(1, 1024),
    help="Worker processes on this machine.  [default: number of cores]",
)
@click.option("--scheduler", help="Address of a Dask scheduler, such as tcp://HOST:8786.")
@click.option(
    "--scheduler-file",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Scheduler file of a Dask scheduler.",
)
@click.option("--tls-ca", help="CA certificate, for a scheduler with TLS.")
@click.option("--tls-cert", help="Certificate of this client.")
@click.option("--tls-key", help="Key of this client.")
@click.option(
    "--pieces",
    type=Count(1, 10_000),
    help="Pieces that each recording is cut into, to be shared by several workers; 1 = uncut.  "
    "[default: enough to keep all workers busy]",
)
@click.option(
    "--shard",
    metavar="I/N",
    help="Process only share I of N (I from 0 to N-1, or 1 to N), without a scheduler, as a job of "
    "an array does. Shares depend on the recordings' names alone.",
)
@click.option(
    "--detach",
    is_flag=True,
    help="Leave the work to the scheduler and end. The same command comes back to it, --status "
    "shows how far it is.",
)
@click.option(
    "--status",
    "only_status",
    is_flag=True,
    help="Process nothing: write the table batch.csv, and print how many recordings are done.",
)
@click.option(
    "--fetch-mb",
    type=Count(1, 10_000_000),
    default=50_000,
    show_default=True,
    help="Maximum size of what is fetched of a recording whose paths are addresses.  [MB]",
)
@click.option(
    "--scratch",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder to work in where OUT is in a store.  [default: one among the temporary files]",
)
@click.option(
    "--retry-failed", is_flag=True, help="Also process recordings that failed or were lost."
)
@click.option(
    "--dry-run",
    is_flag=True,
    help="Check each recording and its options, say what would be written, and write nothing.",
)
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print one line of JSON for each finished recording.",
)
@click.argument("given", nargs=-1, type=click.UNPROCESSED, metavar="")
def batch(
    *,
    out: Path,
    given: tuple[str, ...],
    retry_failed: bool,
    pieces: int | None,
    as_json: bool,
    shard: str | None,
    detach: bool,
    only_status: bool,
    dry_run: bool,
    fetch_mb: int,
    scratch: Path | None,
    **cluster: Any,
) -> int:
    """Process many recordings in parallel, on this machine or on a cluster.

    MANIFEST is a CSV file with the columns left, right, out (a folder under OUT) and any options
    of run; its paths are relative to it. Two quoted patterns can take its place:
    'archive/*/left.mp4' 'archive/*/right.mp4' gives one recording for each match. Options of run on
    the command line apply to all recordings, those in a row to its recording. Run the same command
    again to process what is not done yet.
    """
    from motionstereo_cli.batch.ledger import BatchWatcher, statuses_of
    from motionstereo_cli.batch.manifest import plans
    from motionstereo_cli.batch.stored import kept
    from motionstereo_cli.batch.task import Storage

    shared, inputs = _apart(given)
    if "--overwrite" in shared:
        raise click.UsageError(
            "a batch goes on with what it has begun: to start a recording again, remove its folder "
            "in OUT, or give another OUT"
        )
    entries = _entries(inputs, shared)
    if dry_run:
        return _tried_out(plans(entries, out, plan_of), shard)
    with kept(out, scratch) as (place, address), _bar(len(entries)) as bar:
        found = plans(entries, place, plan_of)
        _say_idle(found)

        def ended(status: Status) -> None:
            bar.update()
            _say_ended(status, as_json=as_json, quiet=not bar.disable)

        watcher = BatchWatcher(say, lambda frames: bar.set_postfix_str(bar.more(frames)), ended)
        process = partial(
            _process_of(shard, cluster, address, {"detach": detach, "pieces": pieces}),
            inputs=[Path(name) for name in inputs if Path(name).is_file()],
            retry_failed=retry_failed,
            storage=Storage(address, 1_000_000 * fetch_mb),
        )
        try:
            statuses = (statuses_of if only_status else process)(found, place, watcher)
        except KeyboardInterrupt:
            again = "run the same command again to continue"
            say("error", f"interrupted: {again}; see {out / 'batch.csv'}")
            return INTERRUPTED_EXIT_CODE
    if detach:
        say("note", f"the scheduler has the work; --status shows it; see {out / 'batch.csv'}")
        return 0
    return _summarise(statuses, address or out, retried=retry_failed)


def _say_idle(found: Mapping[str, RunPlan]) -> None:
    """Say once of each option that has no effect, and for which recordings."""
    idle: dict[str, list[str]] = {}
    for name, plan in found.items():
        for line in plan.idle():
            idle.setdefault(line, []).append(name)
    for line, names in idle.items():
        of = f"{names[0]} and {len(names) - 1} others: " if len(names) > 1 else f"{names[0]}: "
        say("note", line if len(names) == len(found) else of + line)


def _tried_out(found: Mapping[str, RunPlan], shard: str | None) -> int:
    """Say of each recording what would be done, or what is wrong; return the exit code."""
    from motionstereo_cli.batch.shard import Shard
    from motionstereo_cli.runs.run import Watcher, try_out

    if shard is not None:
        Shard.parse(shard)
    failed = 0
    for name, plan in found.items():

        def named(kind: str, text: str, name: str = name) -> None:
            say(kind, f"{name}: {text}")

        try:
            named("note", would_write(plan, *try_out(plan, Watcher(named))))
        except MotionStereoError as error:
            named("error", str(error))
            failed += 1
    say("note", f"a dry run: {failed} of {len(found)} recordings would fail at once")
    return 1 if failed else 0


def _process_of(
    shard: str | None, given: Mapping[str, Any], address: str | None, how: Mapping[str, Any]
) -> Callable[..., list[Status]]:
    """Return what processes the recordings: a share of them, or all on a cluster.

    Args:
        shard: which share; None = all.
        given: the options of the cluster.
        address: of the store where the results go, if any.
        how: ``detach`` and ``pieces``.
    """
    if shard is not None:
        from motionstereo_cli.batch.shard import Shard, run_shard

        for name, value in {**given, **how}.items():
            if value and name != "workers":
                flag = name.replace("_", "-")
                raise click.UsageError(f"--shard works without a scheduler: leave --{flag} out")
        return partial(run_shard, shard=Shard.parse(shard), workers=given["workers"])
    from motionstereo_cli.batch.cluster import Cluster
    from motionstereo_cli.batch.coordinator import run_batch

    tls = {key: given[f"tls_{key}"] for key in ("ca", "cert", "key") if given[f"tls_{key}"]}
    cluster = Cluster(given["workers"], given["scheduler"], given["scheduler_file"], tls)
    if address and not cluster.local:
        raise click.UsageError("OUT in a store needs --shard, or workers of this machine")
    if how["detach"] and cluster.local:
        raise click.UsageError("--detach needs --scheduler: workers of this command end with it")
    return partial(run_batch, cluster=cluster, **how)


def _apart(given: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the options of ``run`` among some arguments, and the rest."""
    context = click.Context(_plan)
    values, rest, _ = _plan.make_parser(context).parse_args(list(given))
    inputs: list[str] = []
    for item in _plan.params:
        if isinstance(item, click.Argument):
            words = values.pop(item.name)
            inputs += (
                [words] if isinstance(words, str) else words if isinstance(words, tuple) else ()
            )
    options = {option.name: option for option in _plan.params}
    shared: list[str] = []
    for name, value in values.items():
        option = options[name]
        assert isinstance(option, click.Option)
        if option.is_flag:
            shared.append((option.opts if value else option.secondary_opts)[0])
            continue
        for each in value if option.multiple else [value]:
            shared += [option.opts[-1], str(each)]
    return shared, [*inputs, *rest]


def _entries(inputs: Sequence[str], shared: Sequence[str]) -> list[ManifestRow]:
    import dataclasses

    from motionstereo_cli.batch.manifest import matched, read_manifest

    if not 1 <= len(inputs) <= 2:
        raise click.UsageError(
            "give a MANIFEST, or the patterns of LEFT and RIGHT in quotes: "
            f"{len(inputs)} inputs were given"
        )
    if len(inputs) == 1 and inputs[0].lower().endswith(".csv"):
        options = {
            flag.removeprefix("--"): option
            for option in _plan.params
            if isinstance(option, click.Option)
            for flag in option.opts
            if flag.startswith("--") and option.name not in _NOT_OF_BATCH
        }
        found = read_manifest(
            inputs[0],
            {name: option.is_flag for name, option in options.items()},
            {name for name, option in options.items() if isinstance(option.type, click.Path)},
        )
    else:
        found = matched(inputs[0], inputs[1] if len(inputs) == 2 else None)
    return [dataclasses.replace(each, options=(*shared, *each.options)) for each in found]


def _bar(recordings: int) -> Any:
    from tqdm import tqdm

    class RecordingsBar(tqdm):  # type: ignore[misc]
        """Recordings, with frames beside them."""

        frames = 0

        def more(self, frames: int) -> str:
            self.frames += frames
            if (told := lines()) is not None:
                told.advance(frames)
            return f"{self.frames} frames"

    hidden = (told := lines()) is not None and not told.aside
    return RecordingsBar(total=recordings, unit="recording", disable=hidden or None)


def _say_ended(status: Status, *, as_json: bool, quiet: bool) -> None:
    from motionstereo_cli.batch.status import row_of

    if (told := lines()) is not None:
        told.tell("recording", recording=row_of(status))
    if as_json:
        click.echo(json.dumps(row_of(status)))
        sys.stdout.flush()
    if status.reason:
        say("error", f"{status.name}: {status.status}: {status.reason}")
    elif not quiet:
        say("note", f"{status.name}: {status.status}, {status.frames} frames")


def _summarise(statuses: Sequence[Status], out: Path | str, *, retried: bool) -> int:
    """Print a summary and return the exit code."""
    from motionstereo_cli.batch.status import FAILED

    counts = {
        name: sum(status.status == name for status in statuses)
        for name in dict.fromkeys(status.status for status in statuses)
    }
    said = ", ".join(f"{count} {name}" for name, count in counts.items()) or "none is in this share"
    number = "1 recording" if len(statuses) == 1 else f"{len(statuses)} recordings"
    say("note", f"{number}: {said}; see {out}/batch.csv")
    if counts.keys() & set(FAILED) and not retried:
        say("note", "the same command with --retry-failed tries what failed or was lost once more")
    if counts.keys() - {"done", "damaged"}:
        return 1
    return DAMAGED_EXIT_CODE if "damaged" in counts else 0
