"""A map that answers questions: words, classes and pictures, and the places of the regions. The module imports little,
to start fast.

All lengths are meters, unless ``SavedMap.metric`` says otherwise. All coordinates are in the map's frame.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..settings import typed_options
from ..storage.saved_map import SavedMap
from . import word_query

if TYPE_CHECKING:
    from ..core.types import Occupancy
    from ..storage.manifest import ChanceRecord
    from .best_views import RegionView
    from .conditions import Where
    from .objects.object import Object
    from .objects.relations import Relation
    from .oriented_boxes import OrientedBox
    from .regions import Region
    from .word_query import Options, QueryResult

    _Ask = Callable[[Occupancy, Options], list[QueryResult]]


class Map(SavedMap):
    """A saved map. ``query("red cup")`` asks it. Its parts are properties, which it reads at first use."""

    def query(self, word: str, **options: Any) -> QueryResult:
        """Finds ``word``: returns regions with score, box, centroid and volume. ``options``: fields of
        ``query.word_query.Options``."""
        return self.query_words([word], **options)[0]

    def query_words(
        self,
        words: list[str],
        contrast: Sequence[str] = (),
        negative: Sequence[str] = (),
        where: Where | None = None,
        objects: bool | None = None,
        **options: Any,
    ) -> list[QueryResult]:
        """``query`` for several words. contrast: words for other things in the scan, added to the encoder's own.
        negative: words for what is not meant.  where: conditions on the places of regions; see
        ``query.conditions.Where``.  objects: whether the first regions are whole objects, where most of an object
        matches (see ``query.objects.ranking``); by default, if the map keeps its objects."""

        def ask(occupancy: Occupancy, asked: Options) -> list[QueryResult]:
            return self._words(words, occupancy, asked, contrast, negative)

        return self._placed(ask, where, objects, options)

    def query_classes(
        self, names: list[str], where: Where | None = None, objects: bool = False, **options: Any
    ) -> list[QueryResult]:
        """Finds the voxels whose nearest name in ``vocabulary`` is each of these; see ``query.class_query``. Of the
        options, only ``top_k`` and ``narrow`` apply. where: as in ``query_words``.  objects: whether the first regions
        are whole objects."""
        from .class_query import query_classes

        def ask(occupancy: Occupancy, asked: Options) -> list[QueryResult]:
            return query_classes(occupancy, self.text_encoder, self.vocabulary, names, asked, self.up)

        return self._placed(ask, where, objects, options)

    def query_image(
        self,
        image: str | Path | NDArray[np.uint8],
        box: tuple[int, int, int, int] | None = None,
        where: Where | None = None,
        objects: bool | None = None,
        **options: Any,
    ) -> QueryResult:
        """Finds where the map looks like a picture, a file or (H, W, 3) RGB, or like a box x0 y0 x1 y1 of its pixels;
        see ``query.image_query``. where, objects: as in ``query_words``."""
        from . import image_query

        feature = image_query.patch_feature(image_query.picture_encoder(self), image, box)
        name = "the picture" if isinstance(image, np.ndarray) else Path(image).name

        def ask(occupancy: Occupancy, asked: Options) -> list[QueryResult]:
            return [image_query.query_feature(occupancy, feature, name, asked, self.up)]

        return self._placed(ask, where, objects, options)[0]

    def objects(self, **options: Any) -> list[Object]:
        """Returns the things of the room, best described first; see ``query.objects.finding``. ``options``: fields of
        ``query.objects.object.Options``."""
        from .objects import finding
        from .objects.object import Options as ObjectOptions

        if options:
            return finding.find_objects(self, typed_options.build(ObjectOptions, options))
        return list(self._objects)

    def labels(self) -> NDArray[np.uint8]:
        """Returns the (V,) class of each occupied voxel: 0 = nothing known, k = ``vocabulary[k - 1]``."""
        return self._class_labels

    def relations_of(self, objects: Sequence[Object]) -> list[list[Relation]]:
        """Returns how each of some objects stands to the others and to the walls; see ``query.objects.relations``."""
        from .objects.relations import find_relations

        return find_relations(self.occupancy, objects, self.T_gravity_map, self.metric)

    def box_of(self, region: Region) -> OrientedBox:
        """Returns the oriented bounding box of a region: upright, with the least level area."""
        return self.boxes_of([region])[0]

    def boxes_of(self, regions: Sequence[Region]) -> list[OrientedBox]:
        """``box_of`` for several regions."""
        if not regions:
            return []
        from .oriented_boxes import oriented_boxes

        return oriented_boxes(self.occupancy, regions, self.T_gravity_map)

    def views_of(self, region: Region) -> list[RegionView]:
        """Returns up to three keyframes that show a region best, with a pixel box in each; see ``query.best_views``."""
        return self.views_of_each([region])[0]

    def views_of_each(self, regions: Sequence[Region]) -> list[list[RegionView]]:
        """``views_of`` for several regions."""
        if not regions:
            return []
        from .best_views import best_views

        return best_views(self.occupancy, self.trajectory, self.keyframes, regions)

    def stand_of(self, region: Region) -> NDArray[np.float64] | None:
        """Returns the (3,) nearest place on the floor, map frame, where a robot can stand and see a region; see
        ``query.standing_places``. None if there is no such place, or if lengths are not meters: a robot has a size."""
        return self.stands_of([region])[0]

    def stands_of(self, regions: Sequence[Region]) -> list[NDArray[np.float64] | None]:
        """``stand_of`` for several regions."""
        if not regions or not self.metric:
            return [None] * len(regions)
        from .standing_places import standing_places

        return standing_places(self.occupancy, self.T_gravity_map, regions)

    @functools.cached_property
    def _objects(self) -> list[Object]:
        if (kept := self.kept_objects) is not None:
            from .objects.keeping import unpack_objects

            return unpack_objects(kept)
        from .objects.finding import find_objects

        return find_objects(self)

    @functools.cached_property
    def _pooled(self) -> Occupancy:
        from .objects.ranking import pool_features

        return pool_features(self.occupancy, self._objects)

    @functools.cached_property
    def _chance(self) -> ChanceRecord:
        """What random words reach in the map: an older map does not state it."""
        from .chance import Chance

        return self.manifest.encoder.chance or Chance(self.occupancy, self.text_encoder).record

    @functools.cached_property
    def _class_labels(self) -> NDArray[np.uint8]:
        text = self.text_encoder.encode_words(self.vocabulary[:253])
        return (word_query.nearest_word(self.occupancy.features, text) + 1).astype(np.uint8)

    def _words(
        self,
        words: list[str],
        occupancy: Occupancy,
        options: Options,
        contrast: Sequence[str] = (),
        negative: Sequence[str] = (),
    ) -> list[QueryResult]:
        named = self.scene_words if self.text_encoder.open_vocabulary else []
        others = [*named, *contrast]
        return word_query.query(
            occupancy, self.text_encoder, words, options, others, negative, self.up, lambda: self._chance
        )

    def _placed(
        self,
        ask: _Ask,
        where: Where | None,
        objects: bool | None,
        options: dict[str, Any],
    ) -> list[QueryResult]:
        """Returns the results with whole objects, if asked for or kept, and only the regions that meet the
        conditions."""
        checked = typed_options.build(word_query.Options, options)
        objects = bool(self.manifest.objects) if objects is None else objects
        if where is None and not objects:
            return ask(self.occupancy, checked)
        every = checked.changed(top_k=max(len(self.occupancy.colors), 1))
        if where is None:
            found = self._with_objects(ask, every)
            return [replace(result, regions=result.regions[: checked.top_k]) for result in found]
        from . import conditions

        answer = self._with_objects if objects else lambda ask, asked: ask(self.occupancy, asked)
        references = answer(functools.partial(self._words, where.words), every) if where.words else []
        return conditions.only_where(self.occupancy, self.up, answer(ask, every), references, where, checked.top_k)

    def _with_objects(self, ask: _Ask, asked: Options) -> list[QueryResult]:
        """Returns the answers with whole objects first."""
        from .objects.ranking import rank_objects

        plain, pooled = ask(self.occupancy, asked), ask(self._pooled, asked)
        return [rank_objects(self.occupancy, *both, self._objects) for both in zip(plain, pooled, strict=True)]


def load_map(path: str | Path) -> Map:
    """Opens a map folder: reads the manifest, and checks that every listed file exists and has its size.

    Raises MapError: no such folder, not a map, a map of a newer version, a missing or damaged file.
    """
    return Map.open(path)
