"""The errors that library code raises. Each message says what happened, where, and what to do."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text in one line that can be printed and stored: line breaks, control characters and bytes that are not text,
    as names of files may hold them, become escapes such as ``\\n``."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class FreeOccError(Exception):
    """A known failure, with a message that a user can act on. The command line prints the message and exits with 1."""

    def __str__(self) -> str:
        """The message, as one line: names of files from outside may hold line breaks, or bytes that are not text."""
        return printable(super().__str__())


class CaptureError(FreeOccError):
    """A capture cannot be read: no such folder, an unknown layout, no depth, unusable intrinsics."""


class FrameError(CaptureError):
    """One frame of a capture cannot be decoded; the frame is skipped and counted."""


class ConfigError(FreeOccError):
    """An option has an unknown name, or a value of the wrong type or out of range; or a backend is unknown."""


class DependencyError(FreeOccError):
    """A backend needs a package that is not installed; the message says which."""


class ModelError(FreeOccError):
    """A model package is missing, damaged, or not in the form that an encoder needs."""


class TrackingError(FreeOccError):
    """The tracker cannot estimate a usable trajectory."""


class MapError(FreeOccError):
    """A map folder is missing, damaged or from a newer version, or it exists where a new map should go."""


class ExportError(FreeOccError):
    """An export cannot be written: the format is unknown, the target unusable, or there is nothing to export."""


class Interrupted(FreeOccError):
    """The user stopped a run. The work done so far is kept, and the run can be resumed."""


def is_interrupt(error: BaseException | None) -> bool:
    """Whether the error is Ctrl-C or comes of it: a compiled function raises a SystemError with Ctrl-C as its cause."""
    return isinstance(error, KeyboardInterrupt) or (error is not None and is_interrupt(error.__cause__))
