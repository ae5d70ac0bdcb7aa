"""Write the list of kernels that the first run on a machine compiles in the background.

    python -m benchmarks.common.record_kernels PHOTOS [PHOTOS ...]

Every folder of photos is reconstructed twice, each time in a process of its own: the second one finds all kernels in
the cache, so that it knows only those that Python calls.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from subprocess import run as run_process

from benchmarks.common.processes import environment
from sfm_app.runtime.compiling import LIST, PARTS

CODE = """
import json, sys
import sfm_app
from sfm_app.runtime.compiling import used_kernels
sfm_app.reconstruct(sys.argv[1], sys.argv[2])
open(sys.argv[3], "w", encoding="utf-8").write(json.dumps(used_kernels()))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", type=Path, metavar="PHOTOS")
    found: dict[str, dict[str, list[list[object]]]] = {part: {} for part in PARTS}
    for photos in parser.parse_args().photos:
        with tempfile.TemporaryDirectory() as folder:
            used = Path(folder) / "used.json"
            for number in (1, 2):
                out = str(Path(folder) / str(number))
                command = [sys.executable, "-P", "-c", CODE, str(photos), out, str(used)]
                run_process(command, check=True, env=environment(), stdout=sys.stderr)
            for part, kernels in json.loads(used.read_text(encoding="utf-8")).items():
                for name, signatures in kernels.items():
                    known = found[part].setdefault(name, [])
                    known += [one for one in signatures if one not in known]
    lines = [
        f' "{part}": {{\n' + ",\n".join(f'  "{name}": {json.dumps(every)}' for name, every in kernels.items()) + "\n }"
        for part, kernels in found.items()
    ]
    LIST.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
