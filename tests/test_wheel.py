"""The wheel alone: installed in an environment without the repository, it trains from an empty folder."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = (
    "interactive_nav_common",
    "interactive_nav",
    "converters",
    "train",
    "topological_nav",
    "scenes_mjcf",
    "benchmarks",
)
SPARSE = ["alder", "birch", "cedar", "elm", "hazel", "juniper", "linden", "maple", "rowan", "willow"]
FILES = ("pyproject.toml", "README.md", "LICENSE")
SHORT = ("ppo.num_envs=8", "ppo.unroll_length=8", "ppo.batch_size=8", "ppo.num_minibatches=1", "run.num_timesteps=512")


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The program `interactive-nav` of an environment that has the wheel and the libraries; an empty folder."""
    base = tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:  # a copy: building leaves files behind
        shutil.copytree(ROOT / name, base / "source" / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(ROOT / name, base / "source")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", base, base / "source"], check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", base / "venv"], check=True)
    python = base / "venv" / "bin" / "python"
    (wheel,) = base.glob("*.whl")
    subprocess.run([*pip, "--python", python, "install", "--no-deps", wheel], check=True)
    (site,) = (base / "venv").glob("lib/python*/site-packages")
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (base / "empty").mkdir()
    return base / "venv" / "bin" / "interactive-nav", base / "empty"


def run(bare: tuple[Path, Path], *words: str, **more: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"INTERACTIVE_NAV_CACHE": str(bare[1].parent / "cache"), **more}
    return subprocess.run([bare[0], *words], cwd=bare[1], env=environment, capture_output=True, text=True)


@pytest.mark.heavy
def test_it_trains_and_is_scored_in_an_empty_folder(bare):
    done = run(bare, "train", "--config", "demo", "run.name=short", *SHORT)
    assert done.returncode == 0, done.stderr
    assert (bare[1] / "runs" / "short" / "summary.json").is_file()
    scored = run(bare, "evaluate", "runs/short", "--episodes", "2", "--policies", "random")
    assert scored.returncode == 0 and "random" in scored.stdout, scored.stderr
    filmed = run(bare, "demo", "-o", "film")
    assert filmed.returncode == 0 and (bare[1] / "film" / "demo.mp4").is_file(), filmed.stderr
    assert sorted(path.name for path in bare[1].iterdir()) == ["film", "runs"]


def test_what_it_knows_by_name(bare):
    listed = run(bare, "scenes", "list").stdout.splitlines()
    assert [line.split()[0] for line in listed if line.endswith("not made")] == ["furnished"] * 11 + ["cluttered"] * 11
    assert [line.split()[2] for line in listed[:10]] == sorted(SPARSE[:8]) + SPARSE[8:]
    assert "alder: is there" in run(bare, "scenes", "make", "alder").stdout
    assert run(bare, "check", "scenes_mjcf/alder").stdout.endswith("alder: 25 of 25 gates pass\n")
    missing = run(bare, "train", "--config", "demo", "env.scenes=[cluttered/train]")
    assert missing.returncode == 2
    assert "make them: python -m converters scenes make cluttered" in missing.stderr.replace("\n", "")


def test_a_word_that_is_no_command(bare):
    done = run(bare, "trian")
    assert done.returncode == 2
    assert done.stderr == "interactive-nav: no command 'trian', did you mean 'train'?; --help lists them\n"
    assert run(bare, "--help").stdout.startswith("usage: interactive-nav COMMAND")
