"""What a training shows while it runs: lines and a bar on the terminal, curves in TensorBoard."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from foretrace.predictor.run_folder import Progress, Row


@contextmanager
def tensorboard(path: Path) -> Iterator[Callable[[Row], None]]:
    """A function that logs a row of metrics for TensorBoard."""
    from torch.utils.tensorboard import SummaryWriter  # takes a second to import

    with ExitStack() as stack:
        writer: SummaryWriter | None = None
        # What its thread dies of, such as a full disk, is raised again when the rows are flushed: once is enough.
        stack.callback(setattr, threading, "excepthook", threading.excepthook)
        threading.excepthook = lambda _: None

        def log(row: Row) -> None:
            nonlocal writer
            epoch = int(row["epoch"])
            writer = writer or stack.enter_context(SummaryWriter(str(path), purge_step=epoch))
            for name, value in row.items():
                writer.add_scalar(name, value, epoch)
            writer.flush()

        yield log


@contextmanager
def terminal(epochs: int, visible: bool) -> Iterator[tuple[Callable[[str], None], Callable[..., None]]]:
    """A progress bar: a function for lines of text and one for the end of an epoch."""
    columns = (TextColumn("epoch {task.completed:.0f}/{task.total:.0f}"), BarColumn())
    numbers = TextColumn("{task.description}")
    with ProgressBar(*columns, numbers, TimeRemainingColumn(), disable=not visible) as bar:
        task = bar.add_task("", total=epochs)

        def show(row: dict[str, Any], done: Progress) -> None:
            kept = (
                done.history[done.best_epoch - 1]["validation_full_cm"] if done.best_epoch else float("nan")
            )
            text = (
                f"loss {row['train_loss']:.5f}, validation {row['validation_full_cm']:.2f} cm "
                f"(kept: {kept:.2f} cm, epoch {done.best_epoch})"
            )
            bar.update(task, completed=done.epoch, description=text)

        yield bar.console.print, show
