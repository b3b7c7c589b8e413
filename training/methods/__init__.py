"""The papers' methods behind one interface. Importing this package needs no torch; making a method does."""


def create(name: str, data, parameters, seed: int, backend: str):
    """The method of a job, ready for its first step; its interface is that of ``flod.Flod``.

    Args:
        name: a key of ``parameters.METHODS``.
        data: a ``data.TrainingData``.
        parameters: a ``parameters.Parameters``.
        backend: the rasterizer's; the tensors live where it draws (``rasterize.device_of``).
    """
    from .flod import Flod

    return {"flod": Flod, "3dgs": Flod}[name](data, parameters, seed, backend)
