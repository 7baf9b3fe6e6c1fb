"""How a long job tells what it is doing: the silent twin here, the one that prints in ``cli``."""

from __future__ import annotations


class Progress:
    """Told of stages, steps and warnings; this one says nothing."""

    def stage(self, name: str, total: int | None = None) -> None:
        """A stage of ``total`` steps begins."""

    def advance(self, done: int) -> None:
        """``done`` steps of the present stage are finished."""

    def warn(self, text: str) -> None:
        """Something that the user should know."""
