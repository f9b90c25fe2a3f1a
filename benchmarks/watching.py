"""What it costs to be watched: recording, drawing, and the page in the browser.

    python -m benchmarks.watching [--task HumanoidAMP] [--num-envs 1024] [--envs-shown 1]

- recording: time that a control step takes longer while a video of it is recorded;
- drawing: CPU time of one video of 100 pictures, drawn without a display and encoded;
- page: time until browsers can connect with `viewer=web`; then, while none does, the share of a CPU
  and the memory that it takes in its process and in the task's, without the task's own steps.
"""

from __future__ import annotations

import argparse
import logging
import os
import statistics
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as train.py, before torch is imported

import torch

from benchmarks.machine import describe_machine
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.viewers.video_writer import VideoJob, write_video
from isaacgymenvs_lite.viewers.web_page import WebPage

_NUM_PICTURES = 100
_PAGE_S = 10.0
_ACTION_NOISE = 0.1


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="HumanoidAMP")
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--envs-shown", type=int, default=1)
    args = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    seed_everything(0)
    cfg = compose([f"task={args.task}", f"num_envs={args.num_envs}"])
    env = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    env.reset()
    recorder = PoseRecorder(env, _NUM_PICTURES, range(args.envs_shown))
    step_s, record_s = _record(env, recorder)
    with tempfile.TemporaryDirectory() as folder:
        film = VideoJob.from_recording(env, recorder, Path(folder) / "video.mp4")
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        write_video(film)
        draw_s, draw_cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    print(describe_machine())
    print(
        f"{args.task}, {args.num_envs} envs, {args.envs_shown} shown:"
        f" recording {1e3 * record_s:.3f} ms of a step's {1e3 * (step_s + record_s):.2f} ms;"
        f" drawing {_NUM_PICTURES} pictures {draw_cpu_s:.1f} s of CPU time in {draw_s:.1f} s;"
        f" page {_page(env)}"
    )
    env.close()


def _record(env: VecTask, recorder: PoseRecorder) -> tuple[float, float]:
    """Return the median times of a step and of recording it."""
    steps_s, records_s = [], []
    for _ in range(_NUM_PICTURES):
        env.reset_done()
        actions = _ACTION_NOISE * torch.randn(env.num_envs, env.num_actions)
        start_s = time.perf_counter()
        env.step(actions)
        middle_s = time.perf_counter()
        recorder.step()
        steps_s.append(middle_s - start_s)
        records_s.append(time.perf_counter() - middle_s)
    return statistics.median(steps_s), statistics.median(records_s)


def _page(env: VecTask) -> str:
    """Return what a page takes whose task makes 100 steps a second."""
    memory_mb, start_s = _memory_mb(os.getpid()), time.perf_counter()
    page = WebPage(env, "localhost", 0, real_time=False)
    try:
        opened_s = time.perf_counter() - start_s
        time.sleep(1.0)
        pids = (page.process.pid, os.getpid())
        before_s = [_cpu_s(pid) for pid in pids]
        start_s = time.perf_counter()
        while time.perf_counter() - start_s < _PAGE_S:
            page.after_step()
            time.sleep(0.01)
        passed_s = time.perf_counter() - start_s
        used_s = [_cpu_s(pid) - before for pid, before in zip(pids, before_s, strict=True)]
        there, here = (f"{seconds / passed_s:.0%} of a CPU" for seconds in used_s)
        grown_mb = _memory_mb(os.getpid()) - memory_mb
        return (
            f"opens in {opened_s:.1f} s; {there} and {_memory_mb(pids[0]):.0f} MB in its process,"
            f" {here} and {grown_mb:.0f} MB in the task's"
        )
    finally:
        page.close()


def _cpu_s(pid: int) -> float:
    """Return the CPU time of a process in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory_mb(pid: int) -> float:
    """Return the memory of a process, without what it shares with others, in MB."""
    total, shared = Path(f"/proc/{pid}/statm").read_text().split()[1:3]
    return (int(total) - int(shared)) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
