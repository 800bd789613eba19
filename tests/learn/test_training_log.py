"""The table of losses of a training."""

from __future__ import annotations

from pathlib import Path

from pfbench.learn.training_job import write_losses


def test_a_table_of_the_user_is_kept_and_an_old_log_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text("mine\n")
    for loss in (2.0, 1.0):
        write_losses(path, [{"epoch": 1, "loss": loss}])
    assert (tmp_path / "data.csv.kept").read_text() == "mine\n"
    assert path.read_bytes() == b"epoch,loss\r\n1,1.0\r\n"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["data.csv", "data.csv.kept"]
