"""``--matcher onnx:MODEL``: a stereo network, by ONNX Runtime.

A TOML file beside the model describes its inputs; otherwise they are found from its shapes. A model
is data: it is read whole, so that it cannot refer to other files, and no custom operators are
    loaded.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import cv2
import numpy as np
from msgspec import Meta, Struct

from motionstereo_cli.errors import InputError, shortage, words_of
from motionstereo_cli.files.reading import read_bytes
from motionstereo_cli.files.records import typed
from motionstereo_cli.method import matching, network
from motionstereo_cli.method.settings import ONNX

if TYPE_CHECKING:
    from motionstereo_cli.method.memory import Memory
    from motionstereo_cli.method.settings import Settings
    from motionstereo_cli.types import Grey, Real

#: The format has no larger ones in a file.
_MAX_BYTES, _MAX_FORM_BYTES = 2_000_000_000, 100_000

_IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}

Side = Annotated[int, Meta(ge=16, le=16_384)]


class ModelForm(Struct, frozen=True, forbid_unknown_fields=True):
    """MODEL.toml: how a model takes images and gives disparity. What is left out is found.

    Attributes:
        inputs: names of the left and the right image, or of one with the channels of both; with
            ``halves`` these come last.
        halves: names of the left and the right image in half their size.
        levels: what grey levels become: ``bytes`` 0..255, ``unit`` 0..1, ``symmetric`` -1..1,
            ``imagenet`` 0..1 less the means of ImageNet and divided by its standard deviations.
        output: name of the disparity.
        channel: which of its channels.
        view: whose disparity it is, ``left`` or ``right``.
        scale: what it has for 1 px; 0: 1, or -1 where most of it is below 0.
        multiple: of which height and width are multiples, where the size is free.
        size: height and width, where it is free and one is wanted.
        large: what becomes of images of another than a fixed size: they are scaled to it
            (``scale``), or taken in ``tiles``.
    """

    inputs: tuple[str, ...] = ()
    halves: tuple[str, ...] = ()
    levels: Literal["", "bytes", "unit", "symmetric", "imagenet"] = ""
    output: str = ""
    channel: Annotated[int, Meta(ge=0, le=64)] = 0
    view: Literal["left", "right"] = "left"
    scale: float = 0.0
    multiple: Annotated[int, Meta(ge=1, le=1024)] = 32
    size: tuple[Side, Side] | None = None
    large: Literal["scale", "tiles"] = "scale"


def model_of(settings: Settings) -> Path | None:
    """Return the model that settings name, None where they name none."""
    name = settings.matcher
    return Path(name.removeprefix(ONNX)) if name.startswith(ONNX) else None


def files_of(settings: Settings) -> list[Path]:
    """Return the files that the matcher is made of: the model, and its form if there is one."""
    model = model_of(settings)
    if model is None:
        return []
    form = model.with_suffix(".toml")
    return [model, form] if form.is_file() else [model]


#: The content of the files of the matchers that are loaded.
_loaded: dict[str, str] = {}


def load_model(settings: Settings) -> None:
    """Make the model that settings name, if they do, a matcher.

    Raises:
        InputError: ONNX Runtime is not installed, or the model or its form cannot be used.
    """
    path = model_of(settings)
    if path is None:
        return
    content = read_bytes(path, "the model", _MAX_BYTES)
    form = _form_of(path)
    known = hashlib.sha256(content).hexdigest() + repr(form)
    if _loaded.get(settings.matcher) != known:
        matching.MATCH[settings.matcher] = _matcher(_Model(content, path, form))
        _loaded[settings.matcher] = known


def _form_of(model: Path) -> ModelForm:
    path = model.with_suffix(".toml")
    if not path.is_file():
        return ModelForm()
    try:
        import tomllib  # which takes time

        values = tomllib.loads(read_bytes(path, "a form", _MAX_FORM_BYTES).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as TOML: {error}") from None
    return typed(values, ModelForm, path)


def _matcher(model: _Model) -> Callable[[Memory, Memory, Settings], matching.Found]:
    def match(right: Memory, left: Memory, settings: Settings) -> matching.Found:
        run = model.for_range(settings.max_disparity)
        found_px = network.in_right_view(run, left.grey, right.grey)
        chance = None
        if settings.check_both:
            found_px, chance = network.agreed(found_px, run(left.grey, right.grey))
        return matching.wanted_of(found_px, right, settings, chance)

    return match


class _Model:
    """A model in ONNX Runtime.

    It runs in one thread: frames are matched side by side, and bytes do not depend on how many are.

    Args:
        content: of its file.
        path: what to call it in messages.
        form: how it takes images.

    Raises:
        InputError: ONNX Runtime is not installed, or it cannot be used.
    """

    def __init__(self, content: bytes, path: Path, form: ModelForm) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise InputError(
                "--matcher onnx needs ONNX Runtime: pip install 'motionstereo[onnx]'"
            ) from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(
                content,
                options,
                providers=["CPUExecutionProvider"],
                enable_fallback=0,  # it would print errors, and try the same again
            )
            inputs = self._session.get_inputs()
            outputs = [each.name for each in self._session.get_outputs()]
            self._shapes = {each.name: each.shape for each in inputs}
            self._kinds = {each.name: each.type for each in inputs}
        except Exception as error:
            raise InputError(
                f"{path} is no model that ONNX Runtime can run ({words_of(error)}): export it "
                "as one file, with its weights"
            ) from error
        self._path, self._form = path, form
        self._halves, self._inputs = self._named()
        self._output = form.output or outputs[0]
        if self._output not in outputs:
            raise InputError(f"{path} has no output {self._output}, but {', '.join(outputs)}")
        self._levels = form.levels or self._usual_levels()
        self._size = self._fixed_size() or form.size

    def _named(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the inputs of half size, and those of the whole one."""
        names, form = tuple(self._shapes), self._form
        halves = form.halves or tuple(name for name in names if "init" in name.lower())
        inputs = form.inputs or tuple(name for name in names if name not in halves)
        if not form.inputs and len(inputs) == 2 and "right" in inputs[0].lower():
            inputs = inputs[::-1]
        if not form.halves and len(halves) == 2 and "right" in halves[0].lower():
            halves = halves[::-1]
        known = set(names) == {*halves, *inputs} and len(inputs) in (1, 2) and len(halves) in (0, 2)
        fits = all(len(self._shapes[name]) == 4 for name in {*halves, *inputs} & set(names))
        if not known or not fits:
            raise InputError(
                f"{self._path} has the inputs {self._shapes}: a left and a right image, or one "
                "with the channels of both, are wanted, [1, channels, height, width]; name them "
                f"in {self._path.with_suffix('.toml')}"
            )
        return halves, inputs

    def _usual_levels(self) -> str:
        if len(self._inputs) == 1:
            return "unit"
        return "imagenet" if self._inputs[0] == "left_image" else "bytes"

    def _fixed_size(self) -> tuple[int, int] | None:
        height, width = self._shapes[self._inputs[0]][2:]
        return (height, width) if isinstance(height, int) and isinstance(width, int) else None

    def for_range(self, max_disparity: int) -> network.Network:
        """Return what gives the disparity of the left view of images of any size.

        Raises:
            InputError: the range is too large for the model's tiles.
        """
        run: network.Network = self._run
        if self._size is None:
            run = network.padded(run, self._form.multiple)
        elif self._form.large == "scale":
            run = network.scaled(run, *self._size)
        else:
            try:
                run = network.tiled(run, *self._size, max_disparity)
            except ValueError as error:
                raise InputError(f"{self._path}: {error}: give a smaller --max-disparity") from None
        return network.of_right_view(run) if self._form.view == "right" else run

    def _run(self, left: Grey, right: Grey) -> Real:
        views = [left, right]
        fed = dict(zip(self._inputs, self._tensors(views, self._inputs), strict=True))
        if self._halves:
            size = left.shape[1] // 2, left.shape[0] // 2
            views = [np.asarray(cv2.resize(view, size), np.uint8) for view in views]
            fed |= dict(zip(self._halves, self._tensors(views, self._halves), strict=True))
        try:
            found = np.asarray(self._session.run([self._output], fed)[0], np.float32)
        except Exception as error:
            if shortage(error):
                raise
            raise InputError(f"{self._path} failed: {words_of(error)}") from error
        if found.ndim == 4:
            by_channel, channel = found.shape[2] == left.shape[0], self._form.channel
            found = found[:, channel] if by_channel else found[..., channel]
        found = found[0] if found.ndim == 3 else found
        if found.shape != left.shape:
            raise InputError(
                f"{self._path} gives {found.shape} for images of {left.shape}: one disparity for "
                "each pixel is wanted"
            )
        scale = self._form.scale or (-1.0 if np.nanmedian(found) < 0 else 1.0)
        found = found / np.float32(scale)
        return np.where(np.isfinite(found) & (found >= 0), found, np.float32(np.nan))

    def _tensors(self, views: list[Grey], names: tuple[str, ...]) -> list[Any]:
        """Return images as inputs of some names, [1, channels, height, width]."""
        channels = self._shapes[names[0]][1]
        each = channels // (2 // len(names)) if isinstance(channels, int) else 3
        tensors = [self._levelled(view, each) for view in views]
        if len(names) == 1:
            tensors = [np.concatenate(tensors, axis=1)]
        kinds = (_TYPES.get(self._kinds[name], np.float32) for name in names)
        return [tensor.astype(kind) for tensor, kind in zip(tensors, kinds, strict=True)]

    def _levelled(self, view: Grey, channels: int) -> Real:
        levels = np.repeat(view[None, None].astype(np.float32), channels, axis=1)
        if self._levels == "bytes":
            return levels
        levels /= np.float32(255)
        if self._levels == "symmetric":
            return levels * np.float32(2) - np.float32(1)
        if self._levels == "imagenet":
            mean, sigma = (
                np.resize(np.array(each, np.float32), channels)[None, :, None, None]
                for each in _IMAGENET
            )
            return (levels - mean) / sigma
        return levels
