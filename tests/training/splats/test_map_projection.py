"""UTM coordinates in geocentric coordinates. PROJ 9.5 is the reference."""

import numpy as np
import pytest

from training.splats.map_projection import UtmZone

REFERENCE = [
    ("EPSG:32633", (500000.0, 5400000.0, 0.0), (4069566.699069, 1090437.110560, 4772494.303029)),
    ("EPSG:32632", (691607.25, 5334783.5, 519.8), (4177956.474600, 855754.089873, 4727474.845498)),
    ("EPSG:32733", (261878.0, 6243185.0, 10.0), (5173855.163544, 1139823.880411, -3539540.759657)),
    (
        "EPSG:32701",
        (833978.5, 1116915.0, -20.0),
        (-1089184.581797, -391347.619013, -6251202.819640),
    ),
    (
        "EPSG:25832",
        (412345.678, 5654321.987, 100.5),
        (3982464.387110, 541982.118143, 4935985.033084),
    ),
    ("EPSG:32660", (166021.4, 9000000.0, 1500.0), (-974362.744465, 385409.580236, 6271905.402876)),
]


@pytest.mark.parametrize(("crs", "position", "expected"), REFERENCE)
def test_positions_agree_with_proj(crs, position, expected):
    zone = UtmZone.from_crs(crs)
    assert zone is not None
    np.testing.assert_allclose(zone.to_ecef(np.array([position]))[0], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("crs", "zone"),
    [
        ("EPSG:32633", UtmZone(33)), ("epsg:32733", UtmZone(33, True)), ("EPSG:25832", UtmZone(32)),
        ('PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84"', UtmZone(33)),
        ('PROJCS["WGS_1984_UTM_Zone_5S",GEOGCS["GCS_WGS_1984"', UtmZone(5, True)),
        ('PROJCRS["ETRS89 / UTM zone 32N",BASEGEOGCRS["ETRS89"', UtmZone(32)),
        ("EPSG:4978", None), ("EPSG:32661", None), ("EPSG:32600", None), ("EPSG:2056", None),
        ('PROJCS["NAD27 / UTM zone 10N",GEOGCS["NAD27"', None), ("", None),
    ],
)  # fmt: skip
def test_zone_of_a_system(crs, zone):
    assert UtmZone.from_crs(crs) == zone
