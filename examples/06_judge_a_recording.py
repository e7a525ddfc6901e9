"""06 Judge a recording: answer its contacts again, then press its tools in by finite elements.

Purpose: what a robot team runs every night on what its robots did by day.
Shows: `Bag`, `replay`, `compare_run`. The command line does the same, and exits with 1 if something is wrong:

    stmpl record --path runs/mine                           # beside a running node, until Ctrl-C
    stmpl replay runs/mine
    stmpl compare runs/mine --tolerance-mm 0.5

    .venv/bin/python examples/06_judge_a_recording.py
"""

from pathlib import Path

from bags.compare import compare_run
from bags.reader import Bag
from bags.replay import replay_run
from fem_tools import RigidFem
from stmpl_core.methods import MomentNet

SAMPLE = Path(__file__).parent.parent / "bags" / "sample"  # a probe presses a coarse forearm and slides
TOLERANCE = 0.5e-3  # m


def main() -> float:
    """Largest mean error under the contact of the frames that were judged [m]."""
    bag = Bag(SAMPLE)
    for topic in bag.topics.values():
        print(f"{topic.messages:5} {topic.type_name:32} {topic.name}")

    # Does this version still answer as the recorded one did?
    print(replay_run(SAMPLE, MomentNet(), every=20))

    # Is the answer right? The same tools are pressed in once more, by finite elements.
    comparison = compare_run(SAMPLE, RigidFem(), frames=2, tolerance=TOLERANCE)
    print(comparison.verdict)
    return comparison.worst_under_contact


if __name__ == "__main__":
    main()
