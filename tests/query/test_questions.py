"""A question in one record."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from freeocc3d.query.conditions import Where
from freeocc3d.query.questions import Question, ask


def test_words_come_first_then_classes_then_the_picture() -> None:
    asked: list[Any] = []

    def answer(*about: Any, **options: Any) -> Any:
        asked.append((*about, options))
        return [f"answer {len(asked)}"]

    scan_map: Any = SimpleNamespace(
        query_words=answer, query_classes=answer, query_image=lambda *a, **o: answer(*a, **o)[0]
    )
    where = Where(pick="best")
    question = Question(["cup"], ["red"], ["sofa"], Path("a.png"), (0, 0, 1, 1), where, {"top_k": 3}, True)
    assert ask(scan_map, question) == ["answer 1", "answer 2", "answer 3"]
    about = {"where": where, "objects": True, "top_k": 3}
    assert asked == [
        (["cup"], {"negative": ["red"], **about}),
        (["sofa"], about),
        (Path("a.png"), (0, 0, 1, 1), about),
    ]
    assert ask(scan_map, Question()) == []
