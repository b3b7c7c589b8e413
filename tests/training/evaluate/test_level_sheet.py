"""Contact sheets of levels."""

import numpy as np
import pytest
import torch
from PIL import Image

from training.evaluate.level_sheet import _write_tiles


@pytest.mark.parametrize(("width", "scale"), [(400, 1), (120, 2), (30, 7)])
def test_captions_do_not_overlap(tmp_path, width, scale):
    """Images of small training sizes are enlarged to the width of the captions, about 200 pixels."""
    images = torch.rand(3, 20, width, 3)
    _write_tiles(tmp_path / "sheet.png", [("level 1   13,536 splats   23.9 dB", image) for image in images])
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape[1] == 3 * (scale * width + 4) - 4
    captions = (sheet[:22] > 100).any(axis=(0, 2))
    for number in range(3):
        begin = number * (scale * width + 4)
        assert captions[begin : begin + scale * width].any()
        assert not captions[begin : begin + 5].any(), "the caption before ends in its own tile"
    pixels = sheet[22:, : scale * width].astype(int)
    expected = (images[0] * 255).round().numpy().repeat(scale, 0).repeat(scale, 1)
    assert np.abs(pixels - expected).max() <= 1
