"""Release a task set: what it says and what happens in its tasks goes into cosim/compete/released.toml, for ever.

python .ci/release.py v1
"""

import sys

from cosim.compete import task_set
from nmfd.runs import config
from nmfd.runs.files import write_text


def main(name: str) -> None:
    released = config.read(task_set.RELEASED)
    if name in released:
        sys.exit(
            f"{name}: was released; a changed task set gets a new number. Delete its table in {task_set.RELEASED} "
            "as long as nobody has it yet"
        )
    loaded = task_set.read(name)
    worlds = {task.id: task_set.world(task, loaded.scenario(task)) for task in loaded.tasks.tasks}
    released[name] = {"hash": loaded.hash, "worlds": worlds}
    lines = ["# Written by .ci/release.py: what was released, which never changes."]
    for one, about in sorted(released.items()):
        lines += ["", f"[{one}]", f'hash = "{about["hash"]}"', "", f"[{one}.worlds]"]
        lines += [f'"{task}" = "{world}"' for task, world in about["worlds"].items()]
    write_text(task_set.RELEASED, "\n".join(lines) + "\n")
    print(f"{task_set.RELEASED}: {name} is {loaded.hash}, with {len(worlds)} tasks")


if __name__ == "__main__":
    main(*sys.argv[1:])
