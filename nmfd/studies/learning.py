"""How a training goes: what it tells after every validation, as a picture and for TensorBoard."""

from pathlib import Path
from typing import Any

from nmfd.extras import need
from nmfd.studies import plots, plots_studies

ALL = "total_time_spent_veh_s"


class Curve:
    """Keeps what `training.train` gives to `log`: Adam steps, TTS in training and in validation [veh s]."""

    def __init__(self, board: Path | None = None):
        """board: a folder for TensorBoard's logs. InputError where that is asked for and not installed"""
        if board:
            need("--log tensorboard", "tensorboard", "tensorboard")
        self.rows: list[tuple[int, float, float]] = []
        self._board = board
        self._writer: Any = None

    def log(self, step: int, trained: float, validated: float) -> None:
        """After a validation."""
        self.rows.append((step, trained, validated))
        if self._board:
            writer = self._writer = self._writer or _writer(self._board)
            writer.add_scalar(f"{ALL}/training", trained, step)
            writer.add_scalar(f"{ALL}/validation", validated, step)

    def draw(self, path: Path, controller: str) -> Path:
        """The picture of it."""
        drawing = plots.figure(6.8, 4.0)
        plots_studies.learning_curve(drawing.subplots(), controller, self.rows)
        return plots.save(drawing, path)

    def __enter__(self) -> "Curve":
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer:
            self._writer.close()


def _writer(folder: Path) -> Any:
    from torch.utils.tensorboard import SummaryWriter  # of an extra: not there for everybody

    return SummaryWriter(str(folder))
