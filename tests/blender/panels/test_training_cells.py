"""The Large Scene panel: the plan of cells, and their progress in training."""

from pathlib import Path

import pytest

from tests.blender.panels.conftest import RecordingLayout
from training.splats.level_colors import level_color

pytestmark = pytest.mark.one_blender


GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"
OUTDATED = "The settings have changed. Plan the cells again."


@pytest.fixture
def root(bpy):
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    return root


@pytest.fixture
def draw(draw_panel):
    return lambda: draw_panel("training_cells", "LODGS_PT_training_cells")


@pytest.fixture
def draw_line(bpy, lodgs, root):
    """Return a function that draws a line of a list and returns its layout: ``draw_line("cells", 0)``."""

    def draw(kind, index):
        layout, settings = RecordingLayout(), root.lodgs.training
        item = settings.planned_cells[index]
        draw_item = getattr(lodgs("panels.training_cells"), f"LODGS_UL_{kind}").draw_item
        draw_item(None, bpy.context, layout, settings, item, 0, settings, "active_cell", index)
        return layout

    return draw


@pytest.fixture
def watch(lodgs, root, tmp_path):
    """The watch of a run of two cells in the panel."""
    module = lodgs("runs.watch")
    watch = module.Watch(lodgs("training.runs.folder").RunFolder(tmp_path), root.session_uid)
    module.watches[root.session_uid] = watch
    return watch


def _part(number, kind, state, step, of=100):
    return {"block": number, "kind": kind, "state": state, "step": step, "of": of}


def test_planning_is_offered_for_several_cells(bpy, root, draw, draw_line):
    settings = root.lodgs.training
    layout = draw()
    assert layout.properties == ["divide_by", "columns", "rows"] and not layout.operators
    assert "One cell trains the scene as a whole." in layout.texts
    settings.columns = 2
    layout = draw()
    assert layout.operators == ["lodgs.plan_cells"] and layout.properties[-1] == "polish"
    bpy.ops.lodgs.plan_cells()
    layout = draw()
    assert {"Views", "Splats", "Memory"} <= set(layout.texts)
    assert layout.properties[-1] == "show_cells" and OUTDATED not in layout.texts
    settings.preset = "standard"
    assert OUTDATED in draw().texts
    settings.planned_cells[0].points, settings.planned_cells[0].splats = 68_349, 1_234_567
    settings.planned_cells[0].steps, settings.planned_cells[0].megabytes = 9812, 2345.6
    assert draw_line("cells", 0).texts == ["1", str(settings.planned_cells[0].views), "1.2 M", "2.3 GB"]
    assert "68,349 initial points, 9,812 steps" in draw().texts
    assert draw_line("cells", 1).colors == [(*level_color(2), 1.0)]


def test_limits_of_splats_and_memory_determine_the_grid(bpy, lodgs, root, draw, monkeypatch):
    cells, settings, calls = lodgs("data.cells"), root.lodgs.training, []
    original = cells.choose_cells

    def choose_cells(job, splats, memory, scene):
        calls.append((job.cells, splats, memory))
        return grid or original(job, splats, memory, scene)

    monkeypatch.setattr(cells, "choose_cells", choose_cells)
    settings.divide_by, settings.cell_splats, grid = "SPLATS", settings.parameters.preset_max_splats, ""
    assert draw().properties == ["divide_by", "cell_splats", "at_once", "polish"]
    bpy.ops.lodgs.plan_cells()
    assert (settings.columns, settings.rows) == (1, 1), "one cell is within the limit"
    assert OUTDATED not in draw().texts
    settings.cell_splats, grid = 5000, "2x1"
    assert OUTDATED in draw().texts
    bpy.ops.lodgs.plan_cells()
    assert calls[-1] == ("1x1", 5000, 0)
    assert (settings.columns, settings.rows, len(settings.planned_cells)) == (2, 1, 2)
    settings.divide_by, settings.cell_memory, grid = "MEMORY", 0.5, ""
    assert draw().properties[:2] == ["divide_by", "cell_memory"]
    with pytest.raises(RuntimeError, match="cells"):
        bpy.ops.lodgs.plan_cells()
    assert calls[-1] == ("1x1", 0, 500_000_000)


def test_settings_that_cannot_be_divided_cause_an_error(root, draw):
    settings = root.lodgs.training
    settings.columns, settings.method = 2, "octree_neural"
    layout = draw()
    assert any("cannot train" in text for text in layout.texts) and not layout.operators
    settings.method, settings.start_from = "lodge", "SCENE"
    assert any("Choose Points in Start From" in text for text in draw().texts)


def test_panel_of_cells_is_not_empty_while_training(bpy, lodgs, root, draw, watch):
    poll = lodgs("panels.training_cells").LODGS_PT_training_cells.poll
    assert watch.running and not poll(bpy.context)
    watch.state = "cancelled"
    assert poll(bpy.context) and draw().properties
    watch.state, root.lodgs.training.planned_for = "running", "{}"
    assert poll(bpy.context) and draw().properties == ["show_cells"]


def test_progress_of_each_cell_is_shown(lodgs, root, draw_panel, draw_line, watch):
    def panel():
        return draw_panel("training", "LODGS_PT_training")

    watch._set_parts(root, [_part(0, "coarse", "running", 40), _part(1, "block", "waiting", 0),
                              _part(2, "block", "waiting", 0)])  # fmt: skip
    assert {"Coarse levels", "40%"} <= set(panel().texts)
    assert draw_line("blocks", 0).texts == ["1", "Waiting"] and draw_line("blocks", 0).operators == [
        "lodgs.cancel_cell"
    ]
    watch.stopping = {("block", 1)}
    assert draw_line("blocks", 0).texts[:2] == ["1", "Cancelled"] and not draw_line("blocks", 0).operators
    watch.stopping = set()
    watch._set_parts(root, [_part(0, "coarse", "done", 100), _part(1, "block", "running", 25),
                              _part(2, "block", "cancelled", 50)])  # fmt: skip
    assert "Coarse levels" not in panel().texts
    assert draw_line("blocks", 0).texts == ["1", "25%"] and draw_line("blocks", 0).operators == [
        "lodgs.cancel_cell"
    ]
    layout = draw_line("blocks", 1)
    assert layout.texts == ["2", "Cancelled at 50%"] and layout.operators == ["lodgs.resume_cell"]
    watch.stopping = {("block", 1)}
    assert draw_line("blocks", 0).texts == ["1", "Stopping at 25%"]
    blocks = [_part(number, "block", "done", 100) for number in (1, 2)]
    seams = [_part(1, "seam", "running", 10, 20), _part(2, "seam", "done", 20, 20)]
    watch._set_parts(root, [*blocks, *seams])
    assert draw_line("blocks", 0).texts == ["1", "Borders, 92%"]
    assert draw_line("blocks", 1).texts == ["2", "Done"] and not draw_line("blocks", 1).operators
    watch.state = "cancelled"
    assert draw_line("blocks", 0).texts == ["1", "Stopped at 92%"]
    assert draw_line("blocks", 0).operators == ["lodgs.resume_cell"]


def test_remaining_time_needs_a_speed(lodgs):
    facts = lodgs("runs.messages").progress_facts
    progress = {
        "level": 1, "levels": 1, "step": 0, "of": 90, "loss": 0.0, "psnr": 0.0, "splats": 0,
        "steps_per_s": 0.0, "eta_s": 0.0, "blocks": [],
    }  # fmt: skip
    assert set(facts(progress)) == {"Step", "Loss", "PSNR, training", "Splats"}
    assert facts(progress | {"steps_per_s": 2.0, "eta_s": 45.0})["Time left"] == "45 s"
