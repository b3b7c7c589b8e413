"""Tables of LODGE (Kulhanek et al. 2025)."""

from __future__ import annotations

from .subject import Subject
from .tables import DRAWN, PSNR, TIME, Column, Paper, Row, Table, Training, Trend, Value, increases

_BASE, _CHUNKS, _UNFILTERED = "Full representation", "2 levels in chunks", "2 levels, all splats in chunks"
_DISTANCES = {1: "d=10", 2: "d=10,28", 3: "d=10,28,47", 4: "d=10,28,47,63"}
_PUBLISHED = {
    1: (26.45, 5.61, 324_000), 2: (26.50, 4.75, 209_000),
    3: (26.46, 4.17, 182_000), 4: (26.50, 4.07, 172_000),
}  # fmt: skip
_CLUSTERS, _VISIBLE = "LOD (d=10,28) + clusters", "LOD (d=10,28) + clusters + vis. filtering"
LOADED = Column("splats loaded", "splats", 0)


def _label(count: int) -> str:
    return f"LOD ({_DISTANCES[count]})"


_BY_SPLATS = (*map(_label, reversed(_DISTANCES)), _BASE)


def _unchunked(subject: Subject) -> dict[str, float]:
    return subject.by_distance(chunks=0)


def _nearest_chunk(subject: Subject) -> dict[str, float]:
    return subject.by_distance(chunks=1, fade=0)


def _faster(value: Value) -> tuple[bool, str]:
    """Frame times of the same drawing differ by several per cent."""
    factors = [value(_BASE, TIME) / value(_label(count), TIME) for count in _DISTANCES]
    return min(factors) >= 1.1, ", ".join(f"{factor:.1f}" for factor in factors) + " times as fast"


def _loses_little(value: Value) -> tuple[bool, str]:
    losses = [value(_BASE, PSNR) - value(_label(count), PSNR) for count in _DISTANCES]
    return max(losses) < 0.3, ", ".join(f"{loss:.2f}" for loss in losses) + " dB"


PAPER = Paper(
    title="LODGE: Level-of-Detail Large-Scale Gaussian Splatting with Efficient Rendering",
    trainings={
        _BASE: Training("lodge", {"levels": 1}),  # with pruning by weight, without levels (Table 3)
        **{
            _label(count): Training("lodge", {"levels": count + 1, "chunks": 1}, base=_BASE)
            for count in _DISTANCES
        },
        _CHUNKS: Training("lodge", {"levels": 3, "chunks": 8}, base=_BASE),
        _UNFILTERED: Training("lodge", {"levels": 3, "chunks": 8, "visible_weight": 0}, base=_BASE),
    },
    tables=(
        Table(
            "Table 3", "Numbers of levels, and chunks", "SmallCity", (PSNR, TIME, DRAWN, LOADED),
            (
                Row(_BASE, _BASE, lambda subject: subject.level(), (26.62, 15.17, 925_000, 2_639_000)),
                *(Row(_label(count), _label(count), _unchunked, _PUBLISHED[count]) for count in _DISTANCES),
                Row(_CLUSTERS, _UNFILTERED, _nearest_chunk, (26.54, 3.62, 244_000, 795_000)),
                Row(_VISIBLE, _CHUNKS, _nearest_chunk, (26.55, 3.15, 185_000, 612_000)),
                Row("Opacity blending", _CHUNKS, lambda subject: subject.by_distance(chunks=1),
                    (26.57, 3.88, 268_000, 877_000)),
            ),
            (
                Trend("Levels make frames faster: one level 2.7 times, four levels 3.7 times.", _faster),
                Trend("Levels lose at most 0.17 dB.", _loses_little),
                increases("Each level reduces the splats in the image.", _BY_SPLATS, DRAWN),
                increases("Visibility filtering reduces the splats to load (by 23 %).",
                          (_VISIBLE, _CLUSTERS), LOADED),
                increases("Blending loads more splats than the nearest chunk (43 %).",
                          (_VISIBLE, "Opacity blending"), LOADED),
            ),
        ),
    ),
    missing=(
        "Table 3: distances are chosen from the scene; the labels give those of the paper. The row with "
        "distances chosen by hand is missing, because they belong to a scene (parameter 'distances').",
        "Tables 1 and 2 compare other programs on scenes of kilometres; make bench-lod measures levels and "
        "chunks on a synthetic town. Table 4 needs phones. Memory is not measured.",
    ),
)  # fmt: skip
