"""What the panel of large scenes says before anything runs, and of the cells while they are trained."""

from pathlib import Path

import pytest

from tests.blender.panels.conftest import Notes
from training.lod.colors import level_color

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def root(bpy):
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    return root


@pytest.fixture
def draw(draw_panel):
    return lambda: draw_panel("training_cells", "LODGS_PT_training_cells")


@pytest.fixture
def line(bpy, lodgs, root):
    """``line("cells", 0)``: what a list of that kind says in a line, and its operators."""

    def drawn(kind, index):
        notes, settings = Notes(), root.lodgs.training
        item = settings.planned_cells[index]
        draw_item = getattr(lodgs("panels.training_cells"), f"LODGS_UL_{kind}").draw_item
        draw_item(None, bpy.context, notes, settings, item, 0, settings, "active_cell", index)
        return notes

    return drawn


@pytest.fixture
def watch(lodgs, root, tmp_path):
    """A run of two cells that the panel believes to be followed."""
    module = lodgs("runs.watch")
    watch = module.Watch(lodgs("training.runs.folder").RunFolder(tmp_path), root.session_uid)
    module.watches[root.session_uid] = watch
    return watch


def _part(number, kind, state, step, of=100):
    return {"block": number, "kind": kind, "state": state, "step": step, "of": of}


def test_the_plan_is_offered_for_more_than_one_cell(bpy, root, draw, line):
    settings = root.lodgs.training
    notes = draw()
    assert notes.properties == ["divide_by", "columns", "rows"] and not notes.operators
    assert "One cell: the scene is trained as a whole." in notes.texts
    settings.columns = 2
    notes = draw()
    assert notes.operators == ["lodgs.plan_cells"] and notes.properties[-1] == "polish"
    bpy.ops.lodgs.plan_cells()
    notes = draw()
    assert {"Views", "Splats", "Memory"} <= set(notes.texts)
    assert notes.properties[-1] == "show_cells" and not any("plan again" in text for text in notes.texts)
    settings.preset = "standard"
    assert "Planned for other settings: plan again." in draw().texts
    settings.planned_cells[0].points, settings.planned_cells[0].splats = 68_349, 1_234_567
    settings.planned_cells[0].steps, settings.planned_cells[0].megabytes = 9812, 2345.6
    assert line("cells", 0).texts == ["1", str(settings.planned_cells[0].views), "1.23 M", "2.3 GB"]
    assert "From 68,349 points, 9,812 steps" in draw().texts
    assert line("cells", 1).colors == [(*level_color(2), 1.0)]


def test_cells_are_found_by_what_one_may_have(bpy, lodgs, root, draw, monkeypatch):
    cells, settings, asked = lodgs("data.cells"), root.lodgs.training, []
    real = cells.choose_cells

    def found(job, splats, memory, scene):
        asked.append((job.cells, splats, memory))
        return grid or real(job, splats, memory, scene)

    monkeypatch.setattr(cells, "choose_cells", found)
    settings.divide_by, settings.cell_splats, grid = "SPLATS", settings.parameters.preset_max_splats, ""
    assert draw().properties == ["divide_by", "cell_splats", "at_once", "polish"]
    bpy.ops.lodgs.plan_cells()
    assert (settings.columns, settings.rows) == (1, 1), "it fits as it is"
    assert not any("plan again" in text for text in draw().texts)
    settings.cell_splats, grid = 5000, "2x1"
    assert "Planned for other settings: plan again." in draw().texts
    bpy.ops.lodgs.plan_cells()
    assert asked[-1] == ("1x1", 5000, 0)
    assert (settings.columns, settings.rows, len(settings.planned_cells)) == (2, 1, 2)
    settings.divide_by, settings.cell_memory, grid = "MEMORY", 0.5, ""
    assert draw().properties[:2] == ["divide_by", "cell_memory"]
    with pytest.raises(RuntimeError, match="cells"):
        bpy.ops.lodgs.plan_cells()
    assert asked[-1] == ("1x1", 0, 500_000_000)


def test_what_cannot_be_divided_is_said_before_it_is_tried(root, draw):
    settings = root.lodgs.training
    settings.columns, settings.method = 2, "octree_neural"
    notes = draw()
    assert any("cannot train cells one by one" in text for text in notes.texts) and not notes.operators
    settings.method, settings.start_from = "lodge", "SCENE"
    assert any("Choose Points in Start From" in text for text in draw().texts)


def test_each_cell_says_how_it_gets_on(lodgs, root, draw_panel, line, watch):
    def panel():
        return draw_panel("training", "LODGS_PT_training")

    watch._take_blocks(root, [_part(0, "coarse", "running", 40), _part(1, "block", "waiting", 0),
                              _part(2, "block", "waiting", 0)])  # fmt: skip
    assert {"Coarse levels", "40%"} <= set(panel().texts)
    assert line("blocks", 0).texts == ["1", "Waiting"] and line("blocks", 0).operators == [
        "lodgs.cancel_block"
    ]
    watch.stopping = {("block", 1)}
    assert line("blocks", 0).texts[:2] == ["1", "Cancelled"] and not line("blocks", 0).operators
    watch.stopping = set()
    watch._take_blocks(root, [_part(0, "coarse", "done", 100), _part(1, "block", "running", 25),
                              _part(2, "block", "cancelled", 50)])  # fmt: skip
    assert "Coarse levels" not in panel().texts
    assert line("blocks", 0).texts == ["1", "25%"] and line("blocks", 0).operators == ["lodgs.cancel_block"]
    notes = line("blocks", 1)
    assert notes.texts == ["2", "Cancelled at 50%"] and notes.operators == ["lodgs.resume_block"]
    watch.stopping = {("block", 1)}
    assert line("blocks", 0).texts == ["1", "Stopping at 25%"]
    blocks = [_part(number, "block", "done", 100) for number in (1, 2)]
    seams = [_part(1, "seam", "running", 10, 20), _part(2, "seam", "done", 20, 20)]
    watch._take_blocks(root, [*blocks, *seams])
    assert line("blocks", 0).texts == ["1", "Borders, 92%"]
    assert line("blocks", 1).texts == ["2", "Done"] and not line("blocks", 1).operators
    watch.state = "cancelled"
    assert line("blocks", 0).texts == ["1", "Stopped at 92%"]
    assert line("blocks", 0).operators == ["lodgs.resume_block"]


def test_no_time_is_told_before_there_is_a_speed(lodgs):
    facts = lodgs("runs.messages").progress_facts
    progress = {
        "level": 1, "levels": 1, "step": 0, "of": 90, "loss": 0.0, "psnr": 0.0, "splats": 0,
        "steps_per_s": 0.0, "eta_s": 0.0, "blocks": [],
    }  # fmt: skip
    assert set(facts(progress)) == {"Step", "Loss", "PSNR, training", "Splats"}
    assert facts(progress | {"steps_per_s": 2.0, "eta_s": 45.0})["Time left"] == "45 s"
