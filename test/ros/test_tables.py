"""Tables answer questions: the queries of docs/batch.md in DuckDB and polars; what the schema promises."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'rcseg[test]'")

from rcseg_core import InputError, SegmenterConfig, segment
from rcseg_core.frame import PinholeCamera, RangeColorFrame
from rcseg_core.result.seen import region_areas
from rcseg_ros.batch.options import BatchOptions
from rcseg_ros.batch.run import BatchRequest, plan_batch, run_batch
from rcseg_ros.batch.runners import InlineRunner
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.segmenting import FrameWork
from rcseg_ros.tables.parquet import check_tables, open_table, read_labels
from rcseg_ros.tables.rows import _Sums, decode_label_image, encode_label_image
from rcseg_ros.tables.schema import KEYS, TABLES, arrow_schema, columns

REPOSITORY = Path(__file__).resolve().parents[2]
DOCUMENT = (REPOSITORY / "docs" / "batch.md").read_text("utf-8")


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The tables of the bundled recording of a moving camera."""
    output = tmp_path_factory.mktemp("tables") / "out"
    options = BatchOptions(SegmenterConfig.preset("fast"))
    request = BatchRequest((str(REPOSITORY / "bags" / "tabletop"),), output, options)
    summary = run_batch(request, plan_batch(request), InlineRunner())
    assert summary.frames == 12 and not summary.faulty
    return output


def examples(language):
    return re.findall(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)


def test_the_queries_of_the_document_run(result, monkeypatch):
    duckdb = pytest.importorskip("duckdb")
    (result.parent / "OUT").symlink_to(result)
    monkeypatch.chdir(result.parent)
    queries = examples("sql")
    assert len(queries) >= 4
    answers = [duckdb.sql(query).fetchall() for query in queries]
    tops = answers[0]
    assert len({row[1] for row in tops}) > 6 and all(0.5 < row[-1] < 1.5 for row in tops)


def test_the_python_of_the_document_runs(result, monkeypatch):
    pytest.importorskip("polars")
    monkeypatch.chdir(result.parent)
    names = {}
    if not (result.parent / "OUT").exists():
        (result.parent / "OUT").symlink_to(result)
    for code in examples("python"):
        exec(compile(code, "batch.md", "exec"), names)
    assert (result.parent / "areas.png").stat().st_size > 5000


def test_polars_and_duckdb_give_the_same(result):
    duckdb, pl = pytest.importorskip("duckdb"), pytest.importorskip("polars")
    files = f"{result}/tables/*/*/surfaces.parquet"
    one = pl.scan_parquet(files).filter(pl.col("kind") == "plane").select("frame_index", "surface", "area_m2")
    other = duckdb.sql(f"SELECT frame_index, surface, area_m2 FROM '{files}' WHERE kind = 'plane'").fetchall()
    assert sorted(one.collect().rows()) == sorted(other) and len(other) > 20


def test_areas_are_those_of_the_scene(result):
    """The table of the rendered scene is seen whole in the first frames; its outline tells its area too."""
    rows = open_table(result, "surfaces").to_table(columns=["frame_index", "area_m2", "polygon"]).to_pylist()
    shapely = pytest.importorskip("shapely")
    outlined = [row for row in rows if row["polygon"] and row["area_m2"] > 0.2]
    assert len(outlined) > 20
    ratios = [shapely.from_wkb(row["polygon"]).area / row["area_m2"] for row in outlined]
    assert 0.97 < np.median(ratios) < 1.03


@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.1])
def test_the_area_of_a_plane_is_that_of_its_outline(tilt):
    """A rectangle of a tilted plane between four rays, by the corners of its quadrilateral."""
    camera = PinholeCamera(100.0, 90.0, 39.5, 29.5)
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    rays = camera.rays(60, 80).astype(float)
    depth = (-2.0 * np.cos(tilt)) / (rays @ normal)
    color = np.full((60, 80, 3), (10, 200, 90), np.uint8)
    frame = RangeColorFrame.from_depth(depth.astype(np.float32), color, camera)
    found = segment(frame, SegmenterConfig())
    areas, colors = region_areas(frame, found.labels, found.regions)
    corners = [
        ray * (-2.0 * np.cos(tilt)) / (ray @ normal)
        for col, row in ((-0.5, -0.5), (79.5, -0.5), (79.5, 59.5), (-0.5, 59.5))
        for ray in [np.array([(col - 39.5) / 100.0, (row - 29.5) / 90.0, 1.0])]
    ]
    a, b, c, d = corners
    expected = 0.5 * np.linalg.norm(np.cross(c - a, d - b))
    np.testing.assert_allclose(areas.sum(), expected * (found.labels > 0).mean(), rtol=0.01)
    np.testing.assert_allclose(colors[0], (10, 200, 90))


def test_every_column_tells_its_unit_and_meaning_and_is_in_the_document(result):
    for table in TABLES:
        schema = open_table(result, table).schema
        assert [field.name for field in schema] == [column.name for column in columns(table)]
        for field in schema:
            assert b"unit" in field.metadata and len(field.metadata[b"doc"]) > 3, (table, field.name)
            assert f"`{field.name}`" in DOCUMENT, (table, field.name)
    assert arrow_schema("frames").metadata[b"rcseg.schema_version"] == b"1"
    assert [column.name for column in KEYS[1:4]] == ["episode_index", "frame_index", "timestamp"]


def test_label_images_go_there_and_back():
    labels = np.random.default_rng(0).integers(0, 65536, (37, 53)).astype(np.int32)
    np.testing.assert_array_equal(decode_label_image(encode_label_image(labels)), labels)
    with pytest.raises(InputError, match="16 bits"):
        encode_label_image(np.full((2, 2), 65536, np.int32))
    with pytest.raises(InputError, match="PNG"):
        decode_label_image(b"")


def test_reading_says_what_is_missing(result, tmp_path):
    with pytest.raises(InputError, match="expected one of frames"):
        open_table(result, "floors")
    with pytest.raises(InputError, match="no tables here"):
        next(read_labels(tmp_path))
    with pytest.raises(InputError, match="not a whole table"):
        check_tables(tmp_path)


def test_without_pyarrow_the_words_say_what_to_install(tmp_path, monkeypatch, capsys):
    from rcseg_ros.cli import main

    monkeypatch.setattr("rcseg_ros.tables.extras.find_spec", lambda name: None)
    for command in (
        ["batch", str(REPOSITORY / "bags")],
        ["replay", str(REPOSITORY / "bags/tabletop"), "--tables"],
    ):
        assert main([*command, "-o", str(tmp_path / "out")]) == 2
        assert "pip install 'rcseg[batch]'" in capsys.readouterr().err


def test_work_without_tables_makes_none():
    with Recording(REPOSITORY / "bags" / "tabletop") as recording:
        assert FrameWork(SegmenterConfig(), recording.decode).tables is None


def test_sums_over_groups_of_regions_are_those_of_single_ones():
    rng = np.random.default_rng(3)
    regions = [
        SimpleNamespace(pixel_count=int(n), centroid=c, persistence=p)
        for n, c, p in zip(rng.integers(1, 99, 6), rng.normal(size=(6, 3)), rng.random(6), strict=True)
    ]
    regions[2].centroid = np.full(3, np.nan)
    areas, colors = rng.random(6), rng.random((6, 3)) * 255
    groups = [[1, 3], [3], [2, 4, 5, 6]]
    sums = _Sums(regions, areas, colors).columns(groups)
    for at, labels in enumerate(groups):
        found = {name: column[at] for name, column in sums.items()}
        mine = [regions[label - 1] for label in labels]
        seen = [one for one in mine if np.isfinite(one.centroid[0])]
        center = sum((one.pixel_count * one.centroid for one in seen), np.zeros(3))
        center = center / sum(one.pixel_count for one in seen) if seen else np.full(3, np.nan)
        color = sum(regions[i - 1].pixel_count * colors[i - 1] for i in labels)
        np.testing.assert_allclose(found["centroid"], center)
        np.testing.assert_allclose(found["mean_color"], color / sum(one.pixel_count for one in mine))
        assert found["area_m2"] == pytest.approx(sum(areas[i - 1] for i in labels))
        assert found["persistence"] == max(one.persistence for one in mine)
    none = _Sums([], np.empty(0), np.empty((0, 3))).columns([])
    assert not any(len(column) for column in none.values())
