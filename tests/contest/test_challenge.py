"""Challenges: the same bytes again, a truth that is withheld, and tables of any program."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from microscopes import configuration

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.files import sha256_of_files
from iscat_analysis.movie import open_stack
from iscat_contest.challenge import (
    ABOUT,
    MANIFEST,
    TRUTH,
    Challenge,
    make_challenge,
    manifest_sha256,
    parts_of_config,
    preset_parts,
    read_challenge,
    truth_beside,
)
from iscat_contest.estimators import find_estimator
from iscat_contest.results import Results, match_movie, read_results
from iscat_contest.scoring import score_challenge, write_archive, write_scores

PIXEL_NM = 84.4
STACKS = 24
_LEFT_OUT = object()


def _parts():
    config = configuration(
        fit={"mode": "mass", "roi_nm": 1400.0},
        bounds={"n_before": 6, "n_after": 6, "photons_per_pixel": 2e4, "pixels": 17,
                "x_nm": 0.0, "y_nm": 0.0},
        background={"method": "sliding"},
        simulation={"shape": [48, 48], "frames": 160, "count": 6, "species": [900.0, 1800.0]},
    )  # fmt: skip
    return parts_of_config(config, STACKS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("challenge") / "small"
    make_challenge(_parts(), out, name="small", seed=4)
    return out


@pytest.fixture(scope="module")
def challenge(folder: Path) -> Challenge:
    return read_challenge(folder)


@pytest.fixture
def estimates(challenge: Challenge) -> pd.DataFrame:
    """Give all events, each with errors of a nanometre and a percent."""
    random = np.random.default_rng(3)
    table = pd.DataFrame(challenge.truth["events"])
    for name in ("x_nm", "y_nm"):
        table[name] += random.normal(0, 8.0, len(table))
    table["mass_kda"] *= 1 + random.normal(0, 0.1, len(table))
    return table.drop(columns=["z_nm", "part", "leave"])


def _scored(challenge: Challenge, table: pd.DataFrame, path: Path) -> dict:
    table.to_csv(path, index=False)
    return score_challenge(challenge, [path])


# ---- making --------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    again = make_challenge(_parts(), tmp_path / "again", name="small", seed=4)
    written = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert again == written
    assert len(written["files"]) == STACKS + 3
    assert manifest_sha256(folder) == manifest_sha256(tmp_path / "again")
    other = make_challenge(_parts(), tmp_path / "other", name="small", seed=5)
    assert other["files"] != again["files"]


def test_stacks_are_as_they_were_drawn_and_say_nothing_of_the_truth(challenge, folder) -> None:
    with open_stack(folder / challenge.events("stack")[0]["file"]) as stack:
        assert stack.shape == (12, 17, 17)
        frames = stack.read(0, 12).astype(float)
    assert frames[:6].mean() == pytest.approx(2e4, rel=0.01)
    assert np.var(frames[:6], axis=0, ddof=1).mean() == pytest.approx(2e4, rel=0.1)
    for path in [*(folder / "config").iterdir(), folder / "manifest.json"]:
        text = path.read_text(encoding="utf-8")
        assert "[simulation" not in text
        assert "seed" not in text


def test_a_blind_challenge_keeps_its_truth_beside_it(tmp_path: Path) -> None:
    out = tmp_path / "blind"
    manifest = make_challenge(_parts()[:1], out, name="small", blind=True)
    assert manifest["blind"]
    assert not (out / "truth.json").exists()
    truth = truth_beside(out)
    assert read_challenge(out).truth["seed"] > 2**20  # drawn, and not the default
    hidden = tmp_path / "elsewhere" / "t.json"
    hidden.parent.mkdir()
    truth.rename(hidden)
    with pytest.raises(DataError, match="blind and its truth is not here"):
        read_challenge(out)
    assert len(read_challenge(out, hidden).truth["events"]) == STACKS
    hidden.write_text(hidden.read_text(encoding="utf-8").replace("0.", "1.", 1), encoding="utf-8")
    with pytest.raises(DataError, match="not the truth of this challenge"):
        read_challenge(out, hidden)


def test_files_that_are_not_those_of_the_manifest_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "small"
    make_challenge(_parts()[:1], out, name="small", seed=4)
    first = out / "stacks" / "stack_0000.tif"
    kept = first.read_bytes()
    first.write_bytes(kept[:-1] + bytes([kept[-1] ^ 1]))
    with pytest.raises(DataError, match=r"stack_0000\.tif: is not the file of the manifest"):
        read_challenge(out)
    first.unlink()
    with pytest.raises(DataError, match="is missing"):
        read_challenge(out)
    with pytest.raises(DataError, match="is no challenge"):
        read_challenge(tmp_path)


def _leaves(values: object, at: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
    """Give the places of all values in a document, of lists the first two and the last."""
    if isinstance(values, dict):
        inside = list(values.items())
    elif isinstance(values, list):
        inside = list(enumerate(values))
        inside = [*inside[:2], *inside[-1:]]
    else:
        return [at]
    return [at, *(leaf for key, one in inside for leaf in _leaves(one, (*at, key)))]


_ODD = (None, "", "../../x", -1, 2, 1e300, 2**70, math.nan, [], {"a": 1}, "x" * 10_000)


def test_a_folder_with_one_changed_value_is_refused_with_its_key(
    folder: Path, estimates, tmp_path: Path
) -> None:
    """Whoever changes a truth changes its hash, too.  What can still be scored is scored."""
    out = tmp_path / "small"
    shutil.copytree(folder, out)
    estimates.to_csv(tmp_path / "ours.csv", index=False)
    texts = {name: (out / name).read_text(encoding="utf-8") for name in (MANIFEST, TRUTH)}
    refused = scored = 0
    for name, text in texts.items():
        for place in _leaves(json.loads(text)):
            for odd in (*_ODD, _LEFT_OUT):
                document, manifest = json.loads(text), json.loads(texts[MANIFEST])
                holder = {"": document}
                for key in ("", *place)[:-1]:
                    holder = holder[key]
                if odd is _LEFT_OUT:
                    del holder[("", *place)[-1]]
                    document = document if place else {}
                else:
                    holder[("", *place)[-1]] = odd
                    document = document if place else odd
                (out / name).write_text(json.dumps(document), encoding="utf-8")
                if name == TRUTH:
                    manifest["truth_sha256"] = sha256_of_files([out / TRUTH])
                    (out / MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
                try:
                    read = read_challenge(out)
                    score_challenge(read, [tmp_path / "ours.csv"])
                    scored += 1
                except DataError as error:
                    refused += 1
                    line = str(error)
                    assert len(line) < 1000
                    assert str(out) in line or TRUTH in line
        for each, kept in texts.items():
            (out / each).write_text(kept, encoding="utf-8")
    assert refused > 1000
    assert scored > 20


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (MANIFEST, lambda m: m.update(version=2), "version: Input should be 1; get the challenge"),
        (MANIFEST, lambda m: m["files"].update({"../a": "0" * 64}), "files.../a"),
        (MANIFEST, lambda m: m["parts"]["stack"].update(n_before=10**9), "n_before: is not 6"),
        (MANIFEST, lambda m: m["parts"].update({"../a": m["parts"]["stack"]}), "parts.../a"),
        (
            TRUTH,
            lambda t: t["events"][3].update(x_nm="12"),
            "events.3.x_nm: Input should be a valid",
        ),
        (TRUTH, lambda t: t["events"][3].update(file="stacks/b.tif"), "events.3.file: is not in"),
        (TRUTH, lambda t: t["events"].append(t["events"][0]), "stacks: is not 25"),
        (TRUTH, lambda t: t["events"][-1].update(frame=160), "particle 5: frame: is impossible"),
        (TRUTH, lambda t: t["parts"]["stack"].update(config="[optics\n"), "parts.stack.config: "),
    ],
)
def test_a_changed_challenge_names_file_and_key(change, name, said, folder, tmp_path: Path) -> None:
    out = tmp_path / "small"
    shutil.copytree(folder, out)
    for which in (name, MANIFEST):
        document = json.loads((out / which).read_text(encoding="utf-8"))
        if which == name:
            change(document)
        if which == MANIFEST:
            document["truth_sha256"] = sha256_of_files([out / TRUTH])
        (out / which).write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(DataError, match=re.escape(said)) as caught:
        read_challenge(out)
    assert "get the challenge again" in str(caught.value)


def test_only_a_truth_is_replaced_by_a_truth(tmp_path: Path) -> None:
    beside = truth_beside(tmp_path / "blind")
    beside.write_text('{"of": "somebody"}', encoding="utf-8")
    with pytest.raises(DataError, match="no truth of ours"):
        make_challenge(_parts()[:1], tmp_path / "blind", name="s", blind=True, overwrite=True)
    assert beside.read_text(encoding="utf-8") == '{"of": "somebody"}'


def test_presets_are_there() -> None:
    for name in ABOUT:
        parts = preset_parts(name)
        assert len({part.name for part in parts}) == len(parts)
    hard = preset_parts("hard")[0]
    assert hard.config.optics != hard.told.optics
    assert hard.told.optics == preset_parts("realistic")[0].config.optics
    with pytest.raises(ConfigError, match="easy, realistic, hard, dong2021"):
        preset_parts("harder")


# ---- scoring -------------------------------------------------------------------------------------


def test_results_are_matched_and_scored(challenge, estimates, tmp_path) -> None:
    found = _scored(challenge, estimates, tmp_path / "ours.csv")
    for part, count in (("stack", STACKS), ("movie", 6)):
        entry = found["parts"][part]["estimators"]["ours"]
        assert entry["trials"] == count
        assert entry["failed"] == 0
        if count > 8:
            assert entry["x_nm"]["rmse"] == pytest.approx(8, rel=0.6)
    recall = found["parts"]["movie"]["estimators"]["ours"]["recall"]
    assert [one["recall"] for one in recall] == [1.0, 1.0]
    assert found["parts"]["movie"]["estimators"]["ours"]["false_alarms"] == 0


def test_the_same_score_twice_to_the_byte(challenge, estimates, tmp_path) -> None:
    for name in ("first", "second"):
        found = _scored(challenge, estimates, tmp_path / "ours.csv")
        write_scores(found, tmp_path / name / "scores")
        write_archive(tmp_path / name / "scores", tmp_path / f"{name}.zip", title="small")
    names = {p.relative_to(tmp_path / "first") for p in (tmp_path / "first").rglob("*.*")}
    assert {"challenge.json", "challenge.html", "benchmark.bib"} <= {p.name for p in names}
    for name in names:
        one, two = (tmp_path / which / name for which in ("first", "second"))
        assert one.is_dir() or one.read_bytes() == two.read_bytes(), name
    assert (tmp_path / "first.zip").read_bytes() == (tmp_path / "second.zip").read_bytes()


def test_an_archive_replaces_none_but_its_own(challenge, estimates, tmp_path: Path) -> None:
    archive = tmp_path / "scores.zip"
    write_scores(_scored(challenge, estimates, tmp_path / "ours.csv"), tmp_path / "scores")
    for _ in range(2):
        write_archive(tmp_path / "scores", archive, title="small", overwrite=True)
    with zipfile.ZipFile(archive, "a") as packed:
        packed.writestr("scores/mine.txt", "of mine")
    kept = archive.read_bytes()
    for content in (kept, b"a letter", b""):
        archive.write_bytes(content)
        with pytest.raises(DataError, match="no archive of ours, and is left alone"):
            write_archive(tmp_path / "scores", archive, title="small", overwrite=True)
        assert archive.read_bytes() == content


def test_a_pipe_is_no_table_of_results(challenge, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "r.csv")
    with pytest.raises(DataError, match="a pipe or a device; give a file"):
        score_challenge(challenge, [tmp_path / "r.csv"])


@pytest.mark.parametrize("blind", [False, True])
def test_who_reads_the_truth_is_found_by_withholding_it(
    blind, folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blurred, a truth that was read looks like an estimate; of a blind challenge there is none."""
    out, truth = tmp_path / "small", tmp_path / "elsewhere" / "of.json"
    shutil.copytree(folder, out)
    if blind:
        truth.parent.mkdir()
        (out / TRUTH).rename(truth)
    monkeypatch.setenv("CHALLENGE", str(out))
    read = read_challenge(out, truth if blind else None)
    found = score_challenge(read, [], [find_estimator("estimators_for_tests:reads_the_truth")])
    (entry,) = found["parts"]["stack"]["estimators"].values()
    assert entry["failed"] == (STACKS if blind else 0)
    if blind:
        assert "FileNotFoundError" in next(iter(entry["failures"]))
    assert found["challenge"]["estimators"].startswith("trusted code")


def test_tables_of_other_programs_give_the_same_score(challenge, estimates, tmp_path) -> None:
    ours = _scored(challenge, estimates, tmp_path / "ours.csv")
    x, y = (estimates[name] / PIXEL_NM for name in ("x_nm", "y_nm"))
    tables = {
        "picasso": {"x": x, "y": y, "photons": estimates["mass_kda"] * 31},
        "thunderstorm": {
            "x [nm]": estimates["x_nm"] + PIXEL_NM / 2, "y [nm]": estimates["y_nm"] + PIXEL_NM / 2,
            "intensity [photon]": estimates["mass_kda"],
        },
        "photomol": {"x_coords": x, "y_coords": y, "masses_kDa": estimates["mass_kda"]},
        "refeyn": {"x_coords": x, "y_coords": y, "contrasts": -1e-5 * estimates["mass_kda"]},
        "piscat": {
            "Fit_X-Center": x, "Fit_Y-Center": y, "Fit_Amplitude": -3e-5 * estimates["mass_kda"],
        },
    }  # fmt: skip
    expected = ours["parts"]["stack"]["estimators"]["ours"]
    for program, columns in tables.items():
        late = 1 if program == "thunderstorm" else 0
        table = pd.DataFrame(columns).assign(file=estimates["file"])
        table["frame_indices" if "x_coords" in table else "frame"] = estimates["frame"] + late
        found = _scored(challenge, table, tmp_path / f"{program}.csv")
        entry = found["parts"]["stack"]["estimators"][program]
        assert entry["x_nm"]["rmse"] == pytest.approx(expected["x_nm"]["rmse"], rel=1e-6)
        factor = 1e-6 if program == "photomol" else 0.1  # one factor is taken from the median
        assert entry["mass_kda"]["rmse"] == pytest.approx(expected["mass_kda"]["rmse"], rel=factor)
        assert any("→" in note for note in entry["notes"])
        movie = found["parts"]["movie"]["estimators"][program]
        assert movie["failed"] == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.drop(columns=["file", "event", "frame"]), "belong to nothing"),
        (lambda t: t.drop(columns=["x_nm", "y_nm", "mass_kda"]), "none of the columns"),
        (lambda t: t.assign(x_nm=t.x_nm / PIXEL_NM, y_nm=t.y_nm / PIXEL_NM), "are in pixels"),
        (lambda t: t.rename(columns={"x_nm": "x_px", "y_nm": "y_px"}), "though called pixels"),
        (lambda t: t.assign(x_nm=t.x_nm / 1000, y_nm=t.y_nm / 1000), "are in µm"),
        (lambda t: t.assign(mass_kda=1000 * t.mass_kda), "masses are in Da"),
        (lambda t: pd.concat([t, t.iloc[:1]]), "twice"),
        (lambda t: pd.concat([t, t.iloc[-1:]]), "repeats an event"),
        (lambda t: t.assign(file="other.tif"), "no row of it is of a file of this challenge"),
        (lambda t: t[t.event < 0], "has no rows"),
    ],
)
def test_bad_tables_are_refused_with_what_to_do(
    change, said: str, challenge, estimates, tmp_path
) -> None:
    with pytest.raises(DataError, match=said):
        _scored(challenge, change(estimates), tmp_path / "bad.csv")


def test_false_alarms_and_misses_are_counted(challenge, estimates, tmp_path) -> None:
    table = estimates[estimates["file"].str.startswith("movies")].drop(columns="event")
    noise = pd.DataFrame({"file": table["file"].iloc[0], "frame": [20, 90], "x_nm": [500.0, 3000.0],
                          "y_nm": [3000.0, 400.0], "mass_kda": [1300.0, 200.0]})  # fmt: skip
    found = _scored(challenge, pd.concat([table.iloc[1:], noise]), tmp_path / "some.csv")
    entry = found["parts"]["movie"]["estimators"]["some"]
    assert entry["false_alarms"] == 2
    assert entry["failed"] == 1
    light, heavy = entry["recall"]
    assert light["recall"] == 0.0  # a false alarm of 1300 kDa stands above all of them
    assert heavy["recall"] > 0.5
    assert "stack" not in [p for p, part in found["parts"].items() if part["estimators"]]
    (tmp_path / "somebody").mkdir()  # whose table is called as the movie is, and names no file
    found = _scored(challenge, table.drop(columns="file"), tmp_path / "somebody" / "movie.csv")
    assert found["parts"]["movie"]["estimators"]["somebody"]["failed"] == 0


def test_a_leaving_is_neither_a_landing_nor_a_false_alarm() -> None:
    events = pd.DataFrame({"x_nm": [1e3], "y_nm": [2e3], "frame": [50], "leave": [90],
                           "mass_kda": [300.0]})  # fmt: skip
    rows = {"x_nm": [1e3, 1e3, 1e3], "y_nm": [2e3, 2e3, 9e3], "frame": [91, 49, 90]}
    table = pd.DataFrame({**rows, "mass_kda": [-301.0, 299.0, -200.0]})
    placed, false = match_movie(Results("movie", table), events, "movie.tif", 1, PIXEL_NM)
    assert placed["mass_kda"].tolist() == [299.0]
    assert false["mass_kda"].tolist() == [-200.0]


def test_built_in_estimators_are_run_on_a_challenge(challenge) -> None:
    found = score_challenge(challenge, [], [find_estimator("iscat")])
    stacks = found["parts"]["stack"]["estimators"]
    assert stacks["iscat"]["failed"] == 0
    squares = [1 / stacks["iscat"][name]["efficiency_crb"] for name in ("x_nm", "y_nm", "mass_kda")]
    assert np.mean(squares) == pytest.approx(1, abs=4 * np.sqrt(2 / (3 * STACKS)))
    assert found["ranking"][0]["estimator"] == "iscat"
    assert not any(one["below_bound"] for one in found["ranking"])


def test_a_folder_of_this_program_is_a_table_of_results(tmp_path: Path) -> None:
    folder = tmp_path / "movie.iscat"
    folder.mkdir()
    values = {name: [1.0, 2.0] for name in ("frame", "x_nm", "y_nm", "mass_kda")}
    table = pd.DataFrame({**values, "status": ["ok", "at_bound"], "flags": ""})
    table.to_csv(folder / "fits.csv", index=False)
    found = read_results(folder, PIXEL_NM)
    assert found.name == "movie"
    assert len(found.table) == 1
