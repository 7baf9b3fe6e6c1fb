"""NPZ: label 254 and the list of classes at their limits."""

from types import SimpleNamespace

import numpy as np
import pytest
from manifests import tiny_manifest
from scenes import occupancy_of

from freeocc3d.export import export_map


def exported(tmp_path, words, labels, options=None):
    """What is read back of a map of two voxels with that vocabulary and those labels."""
    scan_map = SimpleNamespace(
        metric=True, up=np.array((0.0, 0.0, 1.0)),
        occupancy=occupancy_of([(-1, 0, 0), (0, 0, 0)]), manifest=tiny_manifest(),
        vocabulary=words, labels=lambda: np.array(labels, np.uint8),
    )  # fmt: skip
    export_map(scan_map, "npz", tmp_path / "map.npz", options)
    with np.load(tmp_path / "map.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize("form", ["dense", "sparse"])
@pytest.mark.parametrize("words", [0, 1, 253, 254, 300])
def test_nothing_known_is_never_the_number_of_a_class(tmp_path, form, words) -> None:
    last = min(words, 253)
    found = exported(tmp_path, [f"word {n}" for n in range(words)], [0, last], {"form": form})
    assert found["classes"].dtype.kind == "U"  # also without any
    assert len(found["classes"]) == last
    unknown, known = found["labels"].ravel().tolist()
    assert unknown == last + 1 < 255
    assert known == (last if words else last + 1)
    if words:
        assert found["classes"][known - 1] == f"word {last - 1}"
