"""The OpenDRIVE reader against closed forms, and its complaints."""

import math
from pathlib import Path

import numpy as np
import pytest

from roadproof.errors import ScenarioError
from roadproof.roads.opendrive import read_opendrive
from roadproof.roads.records import Clothoid, Cubics, ParamCubic

WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
LANES = f"""<lanes><laneSection s="0">
<left><lane id="1" type="driving">{WIDTH}</lane></left>
<center><lane id="0" type="none"><roadMark sOffset="0" type="broken" color="yellow" width="0.15"/></lane></center>
<right><lane id="-1" type="driving">{WIDTH}</lane></right></laneSection></lanes>"""


def written(folder: Path, geometry: str, *, lanes: str = LANES, road: str = "", extra: str = "") -> Path:
    path = folder / "map.xodr"
    path.write_text(
        f'<OpenDRIVE><road id="7" length="50" junction="-1" {road}>{extra}'
        f"<planView>{geometry}</planView>{lanes}</road></OpenDRIVE>"
    )
    return path


def piece(shape: str, *, length: str = "50") -> str:
    return f'<geometry s="0" x="10" y="20" hdg="0.5" length="{length}">{shape}</geometry>'


def pieces(*, y: str = "0", hdg: str = "0") -> str:
    """A straight line of two pieces, of which the second begins aside or the first is turned."""
    return (
        f'<geometry s="0" x="0" y="0" hdg="{hdg}" length="20"><line/></geometry>'
        f'<geometry s="20" x="20" y="{y}" hdg="{hdg}" length="30"><line/></geometry>'
    )


def test_an_arc_is_the_circle_it_should_be() -> None:
    ds = np.linspace(0.0, 40.0, 81)
    for curvature in (0.1, -0.1, 0.02):
        u, v, heading = Clothoid(curvature, curvature).local(ds, 40.0)
        np.testing.assert_allclose(u, np.sin(curvature * ds) / curvature, atol=1e-12)
        np.testing.assert_allclose(v, (1 - np.cos(curvature * ds)) / curvature, atol=1e-12)
        np.testing.assert_allclose(heading, curvature * ds)


def test_a_spiral_agrees_with_the_power_series_of_the_fresnel_integrals() -> None:
    # With curvature a·s the heading is a·s²/2: the cosine and sine integrals of it, term by term.
    length, end = 30.0, 0.09
    a = end / length
    ds = np.linspace(0.0, length, 61)
    u, v = np.zeros_like(ds), np.zeros_like(ds)
    for n in range(20):
        u += (-1) ** n * (a / 2) ** (2 * n) * ds ** (4 * n + 1) / (math.factorial(2 * n) * (4 * n + 1))
        v += (-1) ** n * (a / 2) ** (2 * n + 1) * ds ** (4 * n + 3) / (math.factorial(2 * n + 1) * (4 * n + 3))
    mine = Clothoid(0.0, end).local(ds, length)
    np.testing.assert_allclose(mine[0], u, atol=1e-10)
    np.testing.assert_allclose(mine[1], v, atol=1e-10)
    np.testing.assert_allclose(mine[2], a * ds * ds / 2)


def test_the_curvature_of_a_cubic_is_that_of_its_whole_length() -> None:
    # v = c p² has the curvature 2c at its start; v = d p³ has 6dp / (1 + (3dp²)²)^1.5, which rises from nothing.
    length, d = 20.0, 0.0002
    p = np.linspace(0.0, length, 33)
    expected = (6 * d * p / (1 + (3 * d * p * p) ** 2) ** 1.5).max()
    by_arc = ParamCubic((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, d), normalized=False)
    assert by_arc.max_curvature(length) == pytest.approx(expected, rel=1e-6)
    normalized = ParamCubic((0.0, length, 0.0, 0.0), (0.0, 0.0, 0.0, d * length**3), normalized=True)
    assert normalized.max_curvature(length) == pytest.approx(expected, rel=1e-6)
    assert Clothoid(0.01, -0.03).max_curvature(length) == 0.03


def test_a_spiral_with_equal_ends_is_an_arc_and_one_without_curvature_a_line() -> None:
    ds = np.linspace(0.0, 10.0, 11)
    for got, expected in zip(Clothoid(0.0, 1e-12).local(ds, 10.0), (ds, 0 * ds, 0 * ds), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-9)


@pytest.mark.parametrize("normalized", [False, True])
def test_a_parametric_cubic_is_its_polynomial(normalized: bool) -> None:
    scale = 20.0 if normalized else 1.0
    shape = ParamCubic((0.0, scale, 0.0, 0.0), (0.0, 0.0, 0.01 * scale**2, 0.0), normalized)
    ds = np.linspace(0.0, 20.0, 21)
    u, v, heading = shape.local(ds, 20.0)
    np.testing.assert_allclose(u, ds)
    np.testing.assert_allclose(v, 0.01 * ds**2)
    np.testing.assert_allclose(heading, np.arctan(0.02 * ds))


def test_cubics_change_piece_at_its_start() -> None:
    cubics = Cubics(np.array([0.0, 10.0]), np.array([[1.0, 0.5, 0.0, 0.0], [6.0, 0.0, 0.1, 0.01]]))
    np.testing.assert_allclose(cubics(np.array([0.0, 4.0, 10.0, 12.0])), [1.0, 3.0, 6.0, 6.48])


def test_offset_and_elevation_that_begin_later_are_zero_before(tmp_path: Path) -> None:
    lanes = LANES.replace("<lanes>", '<lanes><laneOffset s="20" a="1" b="0.5" c="0" d="0"/>')
    hill = '<elevationProfile><elevation s="20" a="0" b="0.1" c="0" d="0"/></elevationProfile>'
    road = read_opendrive(written(tmp_path, piece("<line/>"), lanes=lanes, extra=hill)).roads["7"]
    at = np.array([0.0, 19.9, 20.0, 30.0])
    np.testing.assert_allclose(road.lane_offset(at), [0.0, 0.0, 1.0, 6.0])
    np.testing.assert_allclose(road.elevation(at), [0.0, 0.0, 0.0, 1.0])


def test_a_road_is_placed_by_its_start_pose(tmp_path: Path) -> None:
    road = read_opendrive(written(tmp_path, piece('<arc curvature="0.1"/>'))).roads["7"]
    points, headings = road.reference(np.array([0.0, 10.0]))
    np.testing.assert_allclose(points[0], [10.0, 20.0])
    centre = np.array([10.0 - 10.0 * math.sin(0.5), 20.0 + 10.0 * math.cos(0.5)])
    np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), 10.0)
    np.testing.assert_allclose(headings, [0.5, 1.5])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"geometry": piece("<poly3 a='0' b='0' c='0' d='0'/>")}, "road 7: <geometry> holds <poly3>"),
        ({"geometry": piece("<arc/>")}, "road 7: <arc> has no curvature"),
        ({"geometry": piece('<arc curvature="90"/>')}, "road 7: <geometry> has a curvature of 90 1/m"),
        ({"geometry": piece("<line/>", length="40")}, "road 7: <geometry> goes from 0.000 to 40.000 m"),
        ({"geometry": piece("<line/>", length="-3")}, "road 7: <geometry> has length -3.0 m"),
        ({"lanes": LANES.replace('s="0"', 's="60"')}, "road 7: <laneSection> starts outside"),
        (
            {"lanes": LANES.replace('<width sOffset="0"', '<width sOffset="9"')},
            "lane 1: the first <width> has sOffset 9.0",
        ),
        (
            {"lanes": LANES.replace("<roadMark", '<roadMark sOffset="20" type="solid"/><roadMark')},
            "road 7: lane 0: <roadMark> elements are not ordered by sOffset",
        ),
        ({"lanes": LANES.replace('s="0"', 's="40"')}, "road 7: the first <laneSection> starts at 40.000 m"),
        ({"lanes": LANES.replace('s="0"', 's="0" singleSide="true"')}, "road 7: <laneSection> with singleSide"),
        (
            {"lanes": LANES.replace('type="driving"', 'type="driving" direction="reversed"')},
            "road 7: lane 1: direction 'reversed'",
        ),
        ({"geometry": pieces(y="5")}, "road 7: the <geometry> before 20.000 m ends 5.00 m from where the next"),
        ({"geometry": pieces(hdg="90")}, "road 7: the <geometry> before 20.000 m ends 34.04 m"),
        ({"geometry": piece('<arc curvature="nan"/>')}, "road 7: <arc> has curvature='nan'"),
        ({"geometry": piece("<line/>", length="long")}, "road 7: <geometry> has length='long'"),
        ({"geometry": ""}, "road 7: <planView>"),
        ({"lanes": "<lanes/>"}, "road 7: no <laneSection>"),
        ({"road": 'rule="LHT"'}, "road 7: rule 'LHT'"),
        (
            {"extra": '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'},
            "road 7: <superelevation>",
        ),
        (
            {"lanes": LANES.replace('id="-1"', 'id="1"')},
            "road 7: <laneSection> at 0 m: two <lane> elements have the id 1",
        ),
        ({"lanes": LANES.replace("<width", "<border")}, "road 7: lane 1: <border> is not supported"),
    ],
)
def test_what_is_damaged_or_unsupported_is_named(tmp_path: Path, changes: dict[str, str], said: str) -> None:
    path = written(tmp_path, changes.pop("geometry", piece("<line/>")), **changes)
    with pytest.raises(ScenarioError) as error:
        read_opendrive(path)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_not_maps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    for text, said in [
        ("<osm/>", "expected <OpenDRIVE>"),
        ("<OpenDRIVE>", "not well-formed"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><OpenDRIVE/>', "entities"),
        ("<OpenDRIVE/>", "no <road>"),
        ('<?xml version="1.0" encoding="foo"?><OpenDRIVE/>', "unknown encoding: foo"),
        ('<?xml version="1.0" encoding="big5"?><OpenDRIVE/>', "multi-byte"),
    ]:
        path.write_text(text)
        with pytest.raises(ScenarioError, match=said):
            read_opendrive(path)
    path.write_bytes('<!DOCTYPE x [<!ENTITY a "b">]><OpenDRIVE/>'.encode("utf-16"))
    with pytest.raises(ScenarioError, match="expected UTF-8"):
        read_opendrive(path)
    with pytest.raises(ScenarioError, match="cannot be read"):
        read_opendrive(tmp_path / "missing.xodr")


@pytest.mark.parametrize("tag", ["road", "junction"])
def test_what_has_the_id_of_another_does_not_take_its_place(tmp_path: Path, tag: str) -> None:
    path = written(tmp_path, piece("<line/>"))
    again = path.read_text()[len("<OpenDRIVE>") : -len("</OpenDRIVE>")] if tag == "road" else 2 * '<junction id="7"/>'
    path.write_text(path.read_text().replace("</OpenDRIVE>", f"{again}</OpenDRIVE>"))
    with pytest.raises(ScenarioError, match=f"two <{tag}> elements have the id 7, expected each once"):
        read_opendrive(path)
