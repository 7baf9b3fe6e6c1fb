"""Sums of products agree with NumPy at every length; no kernel of a map leaves the order of a sum to the compiler."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

import freeocc3d
from freeocc3d.core.dot_products import sum_products

ASKING = {"coded_scores.py"}
"""Kernels that answer questions about maps, and that write none."""


@pytest.mark.parametrize("length", [0, 1, 7, 8, 9, 38, 512, 771])
def test_sums_of_products_are_those_of_numpy(length: int) -> None:
    a, b = np.random.default_rng(length).normal(size=(2, length)).astype(np.float32)
    assert sum_products(a, b) == pytest.approx(float(a.astype(np.float64) @ b), abs=1e-4)


def test_no_kernel_of_a_map_has_fastmath() -> None:
    """``fastmath`` makes maps differ between a first run, which compiles, and later ones, which load the cache."""
    root = Path(freeocc3d.__file__).parent
    found = [
        f"{path.relative_to(root)}:{node.value.lineno}"
        for path in root.rglob("*.py")
        if path.name not in ASKING
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.keyword) and node.arg == "fastmath"
    ]
    assert not found
