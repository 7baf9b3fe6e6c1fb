"""How a long job reports its progress. The class here is silent; ``cli`` has the one that prints."""

from __future__ import annotations


class Progress:
    """Receives stages, steps and warnings, and ignores them."""

    def stage(self, name: str, total: int | None = None) -> None:
        """A stage of ``total`` steps begins."""

    def advance(self, done: int) -> None:
        """``done`` steps of the current stage are finished."""

    def note(self, text: str) -> None:
        """A sentence about what is done, if it is not empty."""

    def warn(self, text: str) -> None:
        """The user should know ``text``."""
