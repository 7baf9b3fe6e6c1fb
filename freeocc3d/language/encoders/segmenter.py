"""Any segmentation network (ONNX) with a class list; words match names, synonyms and related words.

The feature of a pixel is its class posteriors p, so the fused feature is their mean over views. The length |p| is 1
where the network is sure, and less elsewhere. The cosine of a fused feature with a class is p_c / |p|. Measured with a
network of 40 classes (bedroom, living; mIoU over the classes present): p 15.4, 12.9; p / |p| 15.3, 12.9; sqrt(p) 15.3,
12.0; the most likely class only 15.3, 12.7; p^(1/4) 12.9, 8.2.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ...capture.base import Capture
from ...capture.class_files import read_class_file, read_class_names
from ...core.errors import ConfigError, FrameError
from ...core.onnx_session import load_network
from ...core.typed_documents import as_type
from ...core.types import Frame
from ...settings.option_types import Device, FilePath, Stride
from ...settings.registry import nearest
from ...settings.typed_options import TypedOptions
from .. import class_names, synonyms
from ..name_embeddings import NameEmbeddings
from .base import Encoder
from .labels import LabelState, LabelWords

REQUIRES: tuple[str, ...] = ("onnxruntime",)

NEEDS_CAPTURE = False

VOID = ("unlabeled", "unlabelled", "unannotated", "unknown", "undefined", "void", "nothing", "none", "ignore")
"""Names of classes that mean nothing, if the option ``void`` is null."""

_INPUTS = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_FREE_SIZE_STEP = 32
"""A network that accepts any input size gets a multiple of this, the usual product of its strides."""
Level = Annotated[float, Meta(ge=-1000, le=1000)]
Spread = Annotated[float, Meta(ge=0.001, le=1000)]
Side = Annotated[int, Meta(ge=1, le=4096)]


class Options(TypedOptions, frozen=True):
    """A network, the names of its classes, and the form of its input."""

    model: str = ""
    """ONNX file. Its input is one RGB image. Its output is the logits or posteriors of each class, or class numbers."""
    classes: str = ""
    """File with the names of the classes in the order of the channels: JSON {"classes": [...]}, or one name per
    line."""
    void: tuple[str, ...] | None = None
    """Names of classes that mean nothing; null = the usual names ("unlabeled", "void" and similar)."""
    mapping: FilePath | None = None
    """YAML file that maps the classes to another taxonomy: classes: [wall, ...], map: {name: class}."""
    embeddings: FilePath | None = None
    """File (.npz) with text embeddings of many names, including the classes: arrays "names" and "embeddings". A name
    means a class if their embeddings are nearer than is usual between names of the file."""
    mean: tuple[Level, Level, Level] = (0.485, 0.456, 0.406)
    """Mean of red, green and blue, in 0…1, to normalize images with; an input of bytes is not normalized."""
    std: tuple[Spread, Spread, Spread] = (0.229, 0.224, 0.225)
    """Standard deviation of red, green and blue, in 0…1, to normalize images with."""
    channels: Literal["rgb", "bgr"] = "rgb"
    """Order of the input's channels: "rgb" or "bgr"."""
    size: tuple[Side, Side] | None = None
    """Width and height of the input; null = as the network states, or near the frame's size if any size is possible."""
    output: Annotated[str, Meta(min_length=1)] | None = None
    """Name of the output with a channel for each class; null = the first such output."""
    stride: Stride = 4
    """Pixels of the frame between features; logits are interpolated."""
    device: Device = "cpu"
    """Device that runs the network: "cpu", or a GPU such as "cuda:0" with onnxruntime-gpu."""


class SegmenterEncoder(Encoder):
    """Class posteriors; void classes are ignored, and so are pixels that are most likely void."""

    name: ClassVar[str] = "segmenter"

    def __init__(
        self, network: SegmentationNetwork, classes: tuple[str, ...], grouping: NDArray[np.float32], options: Options
    ):
        """grouping: (D, C) 1 if class c of the network counts as class d of ``classes``; a void column is zero."""
        self.network = network
        self.classes = classes
        self.grouping = grouping
        self.options = options
        self.dimension = len(classes)
        self.aliases: dict[str, int] = {}

    def encode(self, frame: Frame) -> NDArray[np.float16]:
        """(ceil(H / stride), ceil(W / stride), D) float16 posteriors, which sum to 1 less what is void.

        Raises FrameError if the network's numbers are not finite, ConfigError if it gives a class that has no name.
        """
        height, width = (-(-edge // self.options.stride) for edge in frame.color.shape[:2])
        posteriors = self.network.posteriors(frame, height, width).reshape(height * width, -1)
        known = posteriors @ self.grouping.T
        void = (posteriors * ~self.grouping.any(axis=0)).max(axis=1)
        known[known.max(axis=1) < void] = 0
        return known.astype(np.float16).reshape(height, width, -1)

    def text_state(self) -> dict[str, Any]:
        return {"classes": list(self.classes), "aliases": self.aliases}


class SegmentationNetwork:
    """A session with one image input and one selected output; the file states their forms."""

    def __init__(self, path: Path, n_classes: int, options: Options):
        """Raises ConfigError for a file that cannot be used; the message says why in one sentence."""
        self.path, self.n_classes, self.options = path, n_classes, options
        self.network = load_network(path, options.device)
        self.session = self.network.session
        self.input, self.last, self.size = self._input()
        self.dtype = _INPUTS[self.input.type]
        self.output = self._output()
        # A trial run finds what the shapes leave open, before there is work to lose.
        self._scores(np.zeros((64, 64, 3), np.uint8))

    def posteriors(self, frame: Frame, height: int, width: int) -> NDArray[np.float32]:
        """(height, width, C) float32 class posteriors that cover the frame's image evenly."""
        import cv2

        scores = self._scores(frame.color)
        if not np.isfinite(scores).all():
            raise FrameError(f"{self.path} gives numbers that are not finite for frame {frame.index}: it is left out.")
        scores = cv2.resize(scores, (width, height), interpolation=cv2.INTER_LINEAR)
        return scores if _are_posteriors(scores) else _softmax(scores)

    def _scores(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(h, w, C) the network's output for an image."""
        image = self._image(rgb)
        (given,) = self.network.run([self.output.name], {self.input.name: image}, finite=False)
        return self._by_class(given)

    def _image(self, rgb: NDArray[np.uint8]) -> NDArray[np.generic]:
        """The frame in the form that the input needs."""
        import cv2

        width, height = self.options.size or self.size or (_free_size(rgb.shape[1]), _free_size(rgb.shape[0]))
        shrink = width <= rgb.shape[1] and height <= rgb.shape[0]
        image = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
        if self.dtype != np.uint8:
            mean, std = (np.array(values, np.float32) for values in (self.options.mean, self.options.std))
            image = (image.astype(np.float32) / 255 - mean) / std
        if self.options.channels == "bgr":
            image = image[..., ::-1]
        return np.ascontiguousarray((image if self.last else image.transpose(2, 0, 1))[None].astype(self.dtype))

    def _by_class(self, given: NDArray[Any]) -> NDArray[np.float32]:
        """(h, w, C) logits or posteriors of an output; one-hot if the output contains class numbers."""
        if np.issubdtype(given.dtype, np.integer):
            if given.ndim not in (3, 4) or not given.size:
                raise ConfigError(self._misfit([(self.output.name, given.shape)]))
            numbers = given.reshape(given.shape[-2:]) if given.size == np.prod(given.shape[-2:]) else given[0, ..., 0]
            if numbers.ndim != 2:
                raise ConfigError(self._misfit([(self.output.name, given.shape)]))
            if numbers.min(initial=0) < 0 or numbers.max(initial=0) >= self.n_classes:
                raise ConfigError(
                    f"{self.path} gives class {numbers.max()}, but only {self.n_classes} classes have names: complete "
                    "language.segmenter.classes."
                )
            return np.eye(self.n_classes, dtype=np.float32)[numbers]
        axis = _class_axis(given.shape, self.n_classes, self.last)
        if given.ndim != 4 or axis is None or given.shape[axis] != self.n_classes or not given.size:
            raise ConfigError(self._misfit([(self.output.name, given.shape)]))
        return np.ascontiguousarray(np.moveaxis(given[0], axis - 1, -1), np.float32)

    def _input(self) -> tuple[Any, bool, tuple[int, int] | None]:
        """The input, whether its channels come last, and its width and height if it states them."""
        inputs = self.session.get_inputs()
        described = ", ".join(f"{entry.name} {_shape(entry.shape)} {entry.type}" for entry in inputs)
        fitting = [entry for entry in inputs if len(entry.shape) == 4 and entry.type in _INPUTS]
        last = [entry.shape[3] == 3 and entry.shape[1] != 3 for entry in fitting]
        if len(inputs) != 1 or not fitting or not (last[0] or _may_be(fitting[0].shape[1], 3)):
            raise ConfigError(
                f"{self.path} does not take one RGB image, (1, 3, height, width) or (1, height, width, 3) floats or "
                f"bytes: its input is {described or 'none'}."
            )
        entry = fitting[0]
        if not _may_be(entry.shape[0], 1):
            raise ConfigError(f"{self.path} takes {entry.shape[0]} images at once: export it for one image.")
        height, width = entry.shape[1:3] if last[0] else entry.shape[2:4]
        stated = (width, height) if isinstance(width, int) and isinstance(height, int) else None
        if stated and self.options.size and self.options.size != stated:
            raise ConfigError(
                f"'size' is {self.options.size[0]} x {self.options.size[1]}, but {self.path} takes only images of "
                f"{width} x {height}: set 'size' to null."
            )
        return entry, last[0], stated

    def _output(self) -> Any:
        """The selected output."""
        outputs = {entry.name: entry for entry in self.session.get_outputs()}
        if self.options.output is not None and self.options.output not in outputs:
            raise ConfigError(
                f"{self.path} has no output '{self.options.output}'{nearest(self.options.output, outputs)}. Choose "
                f"from: {', '.join(outputs)}."
            )
        wanted = [outputs[self.options.output]] if self.options.output else list(outputs.values())
        for entry in wanted:
            if "int" in entry.type:
                fits = len(entry.shape) in (3, 4)
            else:
                fits = len(entry.shape) == 4 and _class_axis(entry.shape, self.n_classes, self.last) is not None
            if fits:
                return entry
        raise ConfigError(self._misfit([(entry.name, entry.shape) for entry in wanted]))

    def _misfit(self, outputs: list[tuple[str, Any]]) -> str:
        described = ", ".join(f"{name} {_shape(shape)}" for name, shape in outputs)
        return (
            f"{self.options.classes} names {self.n_classes} classes, but {self.path} has no output with as many "
            f"channels: it has {described}."
        )


class _State(LabelState):
    aliases: dict[str, Annotated[int, Meta(ge=0)]] = msgspec.field(default_factory=dict)


class SegmenterWords(LabelWords):
    """Class names, their synonyms and wider words, and names that mean a class by their text embeddings."""

    threshold = 0.6
    """Less than 0.71, the score of a class if the views are divided between it and another."""

    def __init__(self, classes: list[str], aliases: dict[str, int]):
        super().__init__(["", *classes])
        self.aliases = aliases

    def matching(self, word: str) -> tuple[list[int], str]:
        """Returns the first match among the parts of a phrase, most specific first."""
        found, used = super().matching(word)
        for part in class_names.split_phrase(word):
            if part == used:
                break
            if synonyms.make_key(part) in self.aliases:
                return [self.aliases[synonyms.make_key(part)]], part
        return found, used


def check(options: Options) -> None:
    """Raises ConfigError for a file that is not given or does not exist."""
    for name in ("model", "classes", "mapping", "embeddings"):
        given = getattr(options, name)
        if given == "":
            raise ConfigError(
                f"The encoder 'segmenter' needs a file: set language.segmenter.{name}. freeocc3d includes none."
            )
        if given is not None and not Path(given).is_file():
            raise ConfigError(f"There is no file {given}: correct language.segmenter.{name}.")


def load(options: Options, capture: Capture | None = None) -> SegmenterEncoder:
    """Makes the encoder; it needs nothing from the capture. Raises CaptureError or ConfigError for unusable files."""
    check(options)
    names = read_class_names(Path(options.classes))
    network = SegmentationNetwork(Path(options.model), len(names), options)
    classes, grouping = names, np.eye(len(names), dtype=np.float32)
    if options.mapping:
        mapping = read_class_file(Path(options.mapping))
        classes, grouping = mapping.names, mapping.grouping(names)
    grouping = grouping * ~_void(names, options)
    said = np.asarray(grouping.any(axis=1))
    classes, grouping = tuple(name for name, kept in zip(classes, said.tolist(), strict=True) if kept), grouping[said]
    if not classes:
        raise ConfigError(f"All classes of {options.classes} are void: no class is left to map.")
    encoder = SegmenterEncoder(network, classes, grouping, options)
    if options.embeddings is not None:
        encoder.aliases = _aliases(NameEmbeddings.read(Path(options.embeddings)), classes)
    return encoder


def load_text(state: dict[str, Any]) -> SegmenterWords:
    """Restores the text part. Raises ValueError for a state of another form."""
    kept = as_type(state, _State)
    if any(row >= len(kept.classes) for row in kept.aliases.values()):
        raise ValueError("an alias of no class")
    return SegmenterWords(kept.classes, kept.aliases)


def _void(names: tuple[str, ...], options: Options) -> NDArray[np.bool_]:
    """(C,) whether each class means nothing."""
    lower = [name.lower() for name in names]
    if options.void is None:
        return np.isin(lower, VOID)
    void = [name.lower() for name in options.void]
    if absent := [name for name in void if name not in lower]:
        raise ConfigError(f"The void class '{absent[0]}'{nearest(absent[0], lower)} is not in {options.classes}.")
    return np.isin(lower, void)


def _aliases(names: NameEmbeddings, classes: tuple[str, ...]) -> dict[str, int]:
    """Names that mean a class by their embeddings, and that the synonyms do not contain."""
    known = {name: class_names.match_exactly(name, list(classes))[1] for name in names.names}
    whole = {synonyms.make_key(name) for name, part in known.items() if part == synonyms.normalize_phrase(name)}
    return {key: row for key, row in names.meaning(classes).items() if key not in whole}


def _class_axis(shape: Any, n_classes: int, last: bool) -> int | None:
    """The class axis of a (1, C, h, w) or (1, h, w, C) output, by its length; None if neither fits. last: whether the
    input has its channels last, which decides if both fit. Lengths that are unknown before a run (names) fit."""
    order = (3, 1) if last else (1, 3)
    exact = [axis for axis in order if len(shape) == 4 and shape[axis] == n_classes]
    open_ = [axis for axis in order if len(shape) == 4 and not isinstance(shape[axis], int)]
    return next(iter([*exact, *open_]), None)


def _may_be(edge: Any, length: int) -> bool:
    """Whether an edge of a shape has a length, or is open."""
    return edge == length or not isinstance(edge, int)


def _are_posteriors(scores: NDArray[np.float32]) -> bool:
    """Whether (h, w, C) scores sum to 1 everywhere: the network has its own softmax."""
    return bool(scores.min() >= -1e-6 and np.abs(scores.sum(axis=-1) - 1).max() < 1e-2)


def _softmax(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    odds = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(odds / odds.sum(axis=-1, keepdims=True))


def _free_size(edge: int) -> int:
    return max(round(edge / _FREE_SIZE_STEP), 1) * _FREE_SIZE_STEP


def _shape(shape: Any) -> str:
    return f"({', '.join(str(edge) for edge in shape)})"
