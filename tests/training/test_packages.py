"""Selection of the packages to install."""

import re
from pathlib import Path

from training import packages

ROOT = Path(__file__).resolve().parents[2]


def test_lock_without_cuda_keeps_all_other_packages():
    lock = (ROOT / "requirements" / "cluster.txt").read_text(encoding="utf-8")
    names = set(re.findall(r"^([a-z0-9-]+)==", lock, re.MULTILINE))
    remaining = set(re.findall(r"^([a-z0-9-]+)==", packages.without_cuda(lock), re.MULTILINE))
    removed = names - remaining
    assert {"torch", "triton", "cuda-toolkit", "nvidia-cublas", "nvidia-nccl-cu13"} <= removed
    assert all(name in ("torch", "triton") or name.startswith(("nvidia-", "cuda-")) for name in removed)
    assert {"torchmetrics", "numba", "numpy", "distributed"} <= remaining
    assert packages.without_cuda(lock).count("numpy==") == lock.count("numpy==")


def test_cpu_build_has_the_version_of_the_lock():
    lock = (ROOT / "requirements" / "trainer.txt").read_text(encoding="utf-8")
    version = re.search(r"^torch==([0-9.]+)", lock, re.MULTILINE)[1]
    assert f"torch=={version}+cpu " in packages.TORCH_CPU.read_text(encoding="utf-8")
