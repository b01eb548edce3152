"""What workers of a batch load before they begin, to see what a batch survives."""


def killer_of(part: str) -> str:
    """Return a module by which a recording ends the process that works on it.

    Args:
        part: of the path of the left video of such a recording.
    """
    return f"""
import os, signal
from motionstereo_cli.batch import work as worker
def killing(plan, watcher, run=worker.run):
    if {part!r} in plan.left:
        os.kill(os.getpid(), signal.SIGKILL)
    return run(plan, watcher)
worker.run = killing
"""
