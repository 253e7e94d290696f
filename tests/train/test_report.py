"""A report says what the rows say, in one file that needs no network."""

from __future__ import annotations

import base64
import dataclasses
import functools
import html.parser
import http.server
import json
import threading
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pyarrow as pa

from interactive_nav.pictures.replay import Replay, save_replay
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.rows import write_parquet
from tests.converters.annotate.chromium import tab, until
from tests.train.synthetic import baseline_rows, run_rows
from train.figures import report


class Page(html.parser.HTMLParser):
    """Tables, media and headings of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.tables: list[list[list[tuple[str, dict[str, str | None]]]]] = []
        self.media: list[tuple[str, str]] = []
        self.addresses: list[str] = []
        self.cell: tuple[list[str], dict[str, str | None]] | None = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.cell = ([], given)
        elif tag in ("img", "video"):
            kind, _, data = str(given["src"]).partition(",")
            self.media.append((kind, data))
        self.addresses += [str(given[name]) for name in ("src", "href") if name in given]

    def handle_data(self, data):
        if self.cell:
            self.cell[0].append(data)

    def handle_endtag(self, tag):
        if tag in ("td", "th") and self.cell:
            self.tables[-1][-1].append(("".join(self.cell[0]), self.cell[1]))
            self.cell = None


def write(tmp_path, *results, more=()) -> tuple[str, Page]:
    """What the program writes."""
    out = tmp_path / "report.html"
    assert report.main([*map(str, results), "-o", str(out), *more]) == 0
    text = out.read_text()
    return text, Page(text)


def tiny(run: str, policy: str, success: list[float], p: list[float], e: list[float]) -> pa.Table:
    """Rows of one policy."""
    count = len(success)
    texts = {"run": run, "robot": "turtlebot", "policy": policy, "scene": "den", "split": "test", "device": "toy"}
    numbers = {"success": success, "path_efficiency": p, "effort_efficiency": e, "kinematic_effort": e}
    table = {name: [value] * count for name, value in texts.items()} | numbers
    table |= {
        "dynamic_effort": e,
        "ins_0.5": [0.5 * (a + b) for a, b in zip(p, e, strict=True)],
        "k_int": [0.1] * count,
    }
    table |= {"episode": list(range(count)), "evaluation_seed": [7] * count}
    learned = policy == "learned"
    table["algorithm"] = pa.array(["ppo" if learned else None] * count, pa.string())
    table["seed"] = pa.array([0 if learned else None] * count, pa.int64())
    return pa.table(table)


def test_the_leaderboard_says_what_the_rows_say(tmp_path):
    """Wilson's interval of 3 of 4 is [0.3006, 0.9544]; where all values are the same there is nothing to resample."""
    parts = [
        tiny("a<b>", "learned", [1, 1, 1, 0], [0.75] * 4, [0.5] * 4),
        tiny("a<b>", "mine:1", [1, 1, 1, 1], [0.5] * 4, [1.0] * 4),
        tiny("a<b>", "namo:0.5", [0, 0, 0, 0], [0.0] * 4, [1.0] * 4),
        tiny("a<b>", "random", [0, 0, 0, 0], [0.0] * 4, [0.5] * 4),
    ]
    write_parquet(pa.concat_tables(parts), tmp_path / "rows.parquet")
    text, page = write(tmp_path, tmp_path / "rows.parquet")
    head, *lines = page.tables[0]
    assert [name for name, _ in head] == [
        *("run or policy", "kind", "robot", "scenes", "success", "P_eff", "E_eff", "INS_0.5", "episodes")
    ]
    assert [given["aria-sort"] for _, given in head] == ["none"] * 7 + ["descending", "none"]
    assert [[cell for cell, _ in line][:2] for line in lines] == [
        *(["mine:1", "user's policy"], ["a<b>", "run"], ["namo:0.5", "planner"], ["random", "baseline"])
    ]
    cells = lines[1]
    assert [cell for cell, _ in cells][2:] == [
        *("TurtleBot", "unseen", "0.750 [0.301, 0.954]", "0.750 [0.750, 0.750]", "0.500 [0.500, 0.500]"),
        *("0.625 [0.625, 0.625]", "4"),
    ]
    assert [given.get("data-value") for _, given in cells] == [None] * 4 + ["0.75", "0.75", "0.5", "0.625", "4"]
    both = tmp_path / "rows.parquet", tmp_path / "more.parquet"
    write_parquet(parts[3], both[1])
    _, page = write(tmp_path, *both)
    assert [line[0][0] for line in page.tables[0]] == ["results", *[str(both[0])] * 4, str(both[1])]
    assert "a<b>" not in text and "a&lt;b&gt;" in text


def test_a_part_for_each_folder_and_nothing_from_the_network(tmp_path):
    sweep, other = tmp_path / "sweep", tmp_path / "other"
    for folder in (sweep, other):
        folder.mkdir()
    runs = [run_rows("turtlebot", a, 0.1, seed, 0.8, (0.9, 0.7)) for a in ("ppo", "sac") for seed in (0, 1)]
    write_parquet(pa.concat_tables([*runs, baseline_rows()], promote_options="permissive"), sweep / "rows.parquet")
    lines = [{"env_steps": t, "episode/success": 0.5, "episode/ins_0.5": 0.5} for t in (100, 500)]
    (other / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    text, page = write(tmp_path, sweep, other)
    assert len(page.tables[0]) == 1 + 2 * (4 + 4)  # seen and unseen of four runs and of four that never learned
    (scores,) = [table for table in page.tables[1:] if table[0][0][0] == "robot" and table[0][4][0] == "runs"]
    assert [cell for cell, _ in scores[1]] == [
        *("TurtleBot", "PPO", "0.1", "seen", "2", "40"),
        *("0.950 [0.950, 0.950]", *3 * ("0.800 [0.800, 0.800]",)),  # both seeds have the same: lowest to highest
    ]
    assert all(place.startswith(("data:image/", "#")) for place in page.addresses)
    assert "default-src 'none'" in text and "http" not in text.replace("http-equiv", "")
    second = text.partition('id="part1"')[2]
    for missing in ("rows of policies", "rows", "paths", "replays"):
        assert f"<p>None: no {missing} are here; " in second
    assert second.count("<img ") == 1 and "no metrics.jsonl is here" in text.partition('id="part1"')[0]
    assert report.main([str(tmp_path / "nowhere")]) == 2


def still(room: Path) -> Replay:
    """A replay of three steps in which the robot rests."""
    steps, robot = 3, get_robot("turtlebot")
    return Replay(
        robot="turtlebot",
        scene=str(room),
        scene_digest=load_scene(room).digest,
        control_dt_s=0.1,
        num_objects=0,
        policy="learned",
        episode=0,
        label="",
        bodies=(robot.base_body,),
        num_robot_bodies=1,
        goal_xy_w=np.ones(2, np.float32),
        body_pos_w=np.zeros((steps + 1, 1, 3), np.float32),
        body_quat_w=np.tile(np.array([1, 0, 0, 0], np.float32), (steps + 1, 1, 1)),
        action=np.zeros((steps, 2), np.float32),
        reward=np.zeros(steps, np.float32),
        force_n=np.zeros(steps, np.float32),
        touches_movable=np.zeros(steps, bool),
        touches_structure=np.zeros(steps, bool),
        metrics={},
        small_objects="train",
        objects=(),
        segmentation_classes=4,
        success_distance_m=0.333,
        image_fov_deg=60.0,
        waypoints_b=np.zeros((steps + 1, 10, 2), np.float32),
        reward_names=(),
        reward_terms=np.zeros((steps, 0), np.float32),
    )


def test_films_of_the_best_and_the_worst_replay(tmp_path, room):
    """Three replays of three steps; the middle one is not filmed, and a scene that has changed is said to have."""
    folder, kept = tmp_path / "run" / "replays", still(room)
    for episode, score in ((4, 0.5), (5, 0.9), (6, 0.1)):
        metrics = {
            "ins_0.5": score,
            "success": float(score > 0.2),
            "path_efficiency": score,
            "effort_efficiency": score,
        }
        digest = {"scene_digest": "0" * 64} if episode == 6 else {}
        save_replay(
            dataclasses.replace(kept, episode=episode, metrics=metrics, **digest),
            folder / f"learned-episode{episode}.npz",
        )
    text, page = write(tmp_path, tmp_path / "run")
    ((kind, data),) = page.media
    assert kind == "data:video/mp4;base64"
    (tmp_path / "film.mp4").write_bytes(base64.b64decode(data))
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert frames == 3 + 1 + 15  # the last one stays for 1.5 s
    assert "best: learned, episode 5 in room, reaches the goal, INS_0.5 0.900" in text
    assert "learned-episode6.npz: no film (" in text and "has changed since" in text and "episode 4 in" not in text
    none, page = write(tmp_path, tmp_path / "run", more=("--films", "0"))
    assert page.media == [] and "--films is 0" in none


def test_a_click_sorts_and_a_word_filters(tmp_path):
    """In a real browser: first the highest is on top, then the lowest; a rate of 10 is no text before 9."""
    scores = {"ten": 0.10, "nine": 0.09, "none": 0.0}
    parts = [tiny("r", f"user:{name}", [0, 1], [p] * 2, [0.5] * 2) for name, p in scores.items()]
    write_parquet(pa.concat_tables(parts), tmp_path / "rows.parquet")
    write(tmp_path, tmp_path / "rows.parquet")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    rows = (
        "[...document.querySelectorAll('.sortable tbody tr')].filter(r => !r.hidden).map(r => r.cells[0].textContent)"
    )
    try:
        with tab(f"http://127.0.0.1:{server.server_address[1]}/report.html", tmp_path / "profile") as page:
            there = "document.readyState === 'complete' && !!document.querySelector('.sortable')"
            until(lambda: page.evaluate(there), what="the page")
            head = "document.querySelectorAll('.sortable th')[5]"
            for order, sort in ((["ten", "nine", "none"], "descending"), (["none", "nine", "ten"], "ascending")):
                page.evaluate(f"{head}.firstChild.click()")
                assert page.evaluate(rows) == [f"user:{name}" for name in order]
                assert page.evaluate(f"{head}.ariaSort") == sort
            page.evaluate("filter.value = 'NINE seen'; filter.dispatchEvent(new Event('input'))")
            assert page.evaluate(rows) == ["user:nine"]
    finally:
        server.shutdown()
        server.server_close()
