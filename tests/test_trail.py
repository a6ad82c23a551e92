"""The trail of results: what made a table or a picture is in the file itself; published files have it, too."""

import csv
import json
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trajectories
from PIL import Image

from nmfd.errors import InputError
from nmfd.runs import command, files, frames, run_folder, trail
from nmfd.studies import plots

ROOT = Path(__file__).parents[1]
PUBLISHED = [
    file
    for pattern in ("scenarios/*/reference/**/*", "networks/*/map.png")
    for file in ROOT.glob(pattern)
    if file.suffix in (".csv", ".md", ".png", ".gif") and file.name != "README.md"
]


def shown(file: Path) -> dict:
    """The trail of any file, by other means than those of the package."""
    if file.suffix == ".csv":
        rows = pd.read_csv(file)["trail"]
        assert rows[1:].isna().all()
        return json.loads(rows[0])
    if file.suffix == ".md":
        return json.loads(file.read_text(encoding="utf-8").rpartition("<!-- trail: ")[2].partition(" -->")[0])
    if file.suffix == ".gif":
        return json.loads(_comment(file))
    with Image.open(file) as picture:
        return json.loads(picture.info["Trail"])


def git(*arguments: str) -> str:
    return subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True).stdout.strip()


def _comment(file: Path) -> str:
    """The last one of a gif."""
    content = file.read_bytes()
    at, text = content.rindex(b"\x21\xfe") + 2, b""
    while size := content[at]:
        text += content[at + 1 : at + 1 + size]
        at += 1 + size
    assert content[at + 1 :] == b";"
    return text.decode()


def test_sessions_of_a_folder_are_in_its_tables(tmp_path):
    """A session that only went on is no other one; where it was written, and on how many processes, is not told."""

    def opened(seeds: int, *more: str) -> dict:
        runs = [("mine", seed) for seed in range(seeds)]
        with (
            command.called("nmfd", ["benchmark", "a city", "--seeds", str(seeds), *more]),
            run_folder.open_folder(
                tmp_path / "out",
                configuration={"plant": "nmfd", "network_hash": "n"},
                order=runs,
                controllers={"mine": {"policy_hash": "p", "source_hash": None}},
            ) as folder,
        ):
            for seed in range(seeds):
                folder.add(
                    trajectories.made(
                        controller="mine",
                        plant="nmfd",
                        seed=seed,
                        step=30.0,
                        accumulation=np.zeros((2, 1, 1)),
                        backlog=np.zeros((2, 1, 1)),
                        completed=np.zeros(2),
                        perimeter=np.zeros((1, 1, 1)),
                        splits=np.zeros((1, 1, 1, 1)),
                    )
                )
        return shown(tmp_path / "out" / "summary.csv")

    found = opened(2, "--out", str(tmp_path), "--workers=3")
    wanted = "nmfd benchmark 'a city' --seeds 2"
    assert found["command"] == wanted and found["hashes"] == {".": {"network_hash": "n", "mine": {"policy_hash": "p"}}}
    assert [(one["command"], one["seeds"]) for one in found["runs"]] == [(wanted, [0, 1])]
    session = run_folder.read_manifest(tmp_path / "out" / "manifest.json")["sessions"][0]
    assert all(found[key] == session[key] for key in trail.WRITER)
    assert opened(2, "--scheduler", "tls://there:1", "--scheduler-ca=ca.pem") == found
    assert trail.read(tmp_path / "out" / "summary.csv") == found
    assert [one["seeds"] for one in opened(3)["runs"]] == [[0, 1], [0, 1, 2]]
    assert [row["seed"] for row in run_folder.read_summary(tmp_path / "out" / "summary.csv")] == [0, 1, 2]


def test_what_is_not_made_by_a_command_says_so(tmp_path):
    files.write_table(tmp_path / "a.csv", pd.DataFrame({"x": [1, 2], "y": ["a,b", 'c"d']}))
    found = shown(tmp_path / "a.csv")
    assert found["command"] is None and "runs" not in found and found["versions"]["numpy"]
    assert pd.read_csv(tmp_path / "a.csv")[["x", "y"]].to_dict("list") == {"x": [1, 2], "y": ["a,b", 'c"d']}
    assert files.read_rows(tmp_path / "a.csv", {"x": int, "y": str})[1] == {"x": 2, "y": 'c"d'}
    with pytest.raises(InputError, match="expected the columns"):
        files.read_rows(tmp_path / "a.csv", {"x": int})
    (tmp_path / "manifest.json").write_text('{"sessions": 3}')
    drawing = plots.figure(1.0, 1.0)
    assert shown(plots.save(drawing, tmp_path / "a.png")) == found
    frames.write_parquet(tmp_path / "a.parquet", pd.DataFrame({"x": [1]}))
    assert pd.read_parquet(tmp_path / "a.parquet").attrs["trail"] == found
    files.write_text(tmp_path / "a.md", "text\n" + trail.comment(tmp_path / "a.md"))
    assert shown(tmp_path / "a.md") == found


def test_nothing_ends_a_comment_early_and_a_film_stays_a_film(tmp_path):
    assert "-->" not in trail.text({"command": "nmfd --> <!-- é"})
    pictures = [Image.new("RGB", (4, 4), colour) for colour in ("red", "green", "blue")]
    file = tmp_path / "a.gif"
    pictures[0].save(file, save_all=True, append_images=pictures[1:])
    trail.into_gif(file, trail.text({"long": "x" * 700}))
    assert shown(file) == {"long": "x" * 700}
    with Image.open(file) as film:
        assert film.n_frames == 3
        film.seek(2)
        film.load()


@pytest.mark.parametrize("content", ["", "a,trail\n", "a,trail\n1,\n", "a,trail\n1,[1]\n", "a,trail\n1,{\n", "a\n1\n"])
def test_a_table_without_a_trail(tmp_path, content):
    (tmp_path / "a.csv").write_text(content)
    assert trail.read(tmp_path / "a.csv") == {} == trail.read(tmp_path / "b.csv")


def test_every_published_table_and_picture_has_one():
    """Of old ones what is known, "unknown" for the rest; a commit that it names is one of this repository."""
    assert len(PUBLISHED) > 50
    commits = set()
    for file in PUBLISHED:
        found = shown(file)
        assert {"command", "commit", "dirty", "versions"} <= set(found), file
        commits |= {one["commit"] for one in (found, *found.get("runs", ()), found.get("published", found))}
        assert found["commit"] != trail.UNKNOWN or "published" in found, file
    if git("rev-parse", "--is-shallow-repository") == "false":  # a checkout, and a whole one
        for commit in commits - {trail.UNKNOWN, None}:
            assert git("cat-file", "-t", commit) == "commit", commit


def test_a_published_table_has_its_numbers_still():
    with (ROOT / "scenarios" / "bologna" / "reference" / "runs.csv").open(newline="", encoding="utf-8") as stream:
        row = next(csv.DictReader(stream))
    assert row["total_time_spent_veh_s"] == "5848920.0" and row["programmed_intergreen_share"] == ""


def test_an_older_table_says_how_its_rows_were_made(tmp_path):
    """Also where that is known from a README only: as a run of its own, not as one of the table that it is in now."""
    unknown = dict.fromkeys(("commit", "dirty", "versions"), "unknown")
    before = {"command": "unknown", **unknown, "readme": ["cosim evaluate city"], "not_again": {"a*": "older"}}
    (tmp_path / trail.EARLIER).mkdir()
    pd.DataFrame({"seed": [1], "trail": [json.dumps(before)]}).to_csv(tmp_path / trail.EARLIER / "b.csv", index=False)
    found = trail.of(tmp_path / "runs.csv")
    assert found["commit"] != "unknown" and "readme" not in found
    assert found["runs"] == [{"command": "cosim evaluate city", **unknown, "seeds": []}]
    assert found["not_again"] == {"a*": "older"}
    assert trail.commands(found) == [("cosim evaluate city", found["runs"][0])]
