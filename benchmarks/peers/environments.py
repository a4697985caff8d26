"""An interpreter for every entry: a virtual environment with the packages its file names."""

import ast
import hashlib
import json
import subprocess
import sys
from pathlib import Path


def named(entry: Path, name: str, default):
    """The literal that an entry's file assigns to a name, without running it."""
    for node in ast.parse(entry.read_text()).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == name:
            try:
                return ast.literal_eval(node.value)
            except ValueError:
                return default
    return default


def interpreter(entry: Path, folder: Path) -> tuple[str, str]:
    """Return the interpreter of an entry, made when it is not there, and why there is none (one of them empty).

    An entry without ``PACKAGES`` (optid's own) runs in this interpreter.
    """
    packages = named(entry, "PACKAGES", [])
    if not packages:
        return sys.executable, ""
    digest = hashlib.sha256(" ".join([*packages, sys.version]).encode()).hexdigest()[:8]
    place = folder / f"{entry.stem.strip('_')}-{digest}"
    python, ready = place / "bin" / "python", place / "versions.json"
    if ready.exists():
        return str(python), ""
    print(f"making an environment with {' '.join(packages)} in {place}", flush=True)
    for command in ([sys.executable, "-m", "venv", str(place)],
                    [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages]):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
            return "", lines[-1] if lines else f"{command[2]} ended with {done.returncode}"
    listed = subprocess.run([str(python), "-m", "pip", "list", "--format", "json", "--disable-pip-version-check"],
                            capture_output=True, text=True)
    ready.write_text(json.dumps({p["name"]: p["version"] for p in json.loads(listed.stdout or "[]")}, indent=1))
    return str(python), ""
