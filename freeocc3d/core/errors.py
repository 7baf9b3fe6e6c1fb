"""The one family of errors that library code raises; each message says what, where, and what to do."""

from __future__ import annotations


class FreeOccError(Exception):
    """A known failure, told in one sentence that a user can act on. The command line prints it and exits with 1."""


class CaptureError(FreeOccError):
    """A capture cannot be read: no such folder, an unknown layout, no depth, unusable intrinsics."""


class FrameError(CaptureError):
    """One frame of a capture cannot be decoded; the frame is skipped and counted."""


class ConfigError(FreeOccError):
    """A configuration names an unknown key or backend, or gives a value of the wrong type or range."""


class DependencyError(FreeOccError):
    """A backend needs a package that is not installed; the message says which."""


class ModelError(FreeOccError):
    """A model package is missing, damaged, or not of the form that an encoder needs."""


class TrackingError(FreeOccError):
    """No usable trajectory could be estimated."""


class MapError(FreeOccError):
    """A map folder is missing, damaged, from a newer version, or in the way of a new one."""


class ExportError(FreeOccError):
    """An export cannot be written: unknown format, unusable target, nothing to export."""


class Interrupted(FreeOccError):
    """The user stopped a run; the work done so far is kept and can be resumed."""
