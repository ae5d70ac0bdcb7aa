"""Run the steps of a Dockerfile in bare Debian roots, without Docker; needs root, debootstrap and unshare."""

import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.anywhere.dockerfile import Stage, Step

CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")
"""By which the host reaches the registries; steps find them in /run."""
SHARED_MEMORY_MB = 64
"""What Docker gives a container by default."""
MOUNTS = """
mount --rbind /dev "$0/dev"
mount -t tmpfs -o size=SHAREDm tmpfs "$0/dev/shm"
mount -t proc proc "$0/proc"
mount -t tmpfs -o mode=1777 tmpfs "$0/tmp"
mount -t tmpfs tmpfs "$0/run"
"""
START_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


@dataclass
class Image:
    """A root, and how commands are run in it."""

    root: Path
    variables: dict[str, str] = field(default_factory=lambda: {"PATH": START_PATH})
    folder: str = "/"
    entry: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)

    def size_mb(self) -> float:
        """Return what its files take on the disk."""
        said = subprocess.run(["du", "-sxk", str(self.root)], check=True, capture_output=True, text=True).stdout
        return int(said.split()[0]) * 1024 / 1e6


def build(stages: Sequence[Stage], context: Path, work: Path, *, reuse: bool = False) -> Image:
    """Run all stages, and return the last one.

    Args:
        stages: of a Dockerfile.
        context: the folder from which it copies.
        work: where roots are made; the Debian ones are kept.
        reuse: take the roots as an earlier call has left them.
    """
    images: dict[str, Image] = {}
    for number, stage in enumerate(stages):
        image = images[stage.name] = Image(work / f"stage{number}")
        if not reuse:
            subprocess.run(["rm", "-rf", "--one-file-system", str(image.root)], check=True)
            subprocess.run(["cp", "-a", str(_debian(stage.base, work)), str(image.root)], check=True)
        for step in stage.steps:
            if not (reuse and step.keyword in ("RUN", "COPY")):
                print(f"[{number + 1}/{len(stages)}] {step.keyword} {step.text[:100]}", flush=True)
                _take(step, image, context, images)
    return image


def run(image: Image, arguments: Sequence[str], data: Path, user: str) -> subprocess.CompletedProcess[str]:
    """Run the image's command as an ordinary user, without a network, with a folder of the host as /data.

    Args:
        image: built.
        arguments: of its entry point.
        data: the folder.
        user: ids of user and group, such as "1234:1234".
    """
    (image.root / "data").mkdir(exist_ok=True)
    mounts = f'{MOUNTS}mount --bind {shlex.quote(str(data.resolve()))} "$0/data"\n'
    return _enter(image, [*image.entry, *arguments], mounts, user, "--net")


def _debian(base: str, work: Path) -> Path:
    """Return a bare root of the suite that an image such as debian:trixie-slim is named after."""
    suite = base.removeprefix("debian:").removesuffix("-slim")
    root = work / f"debian-{suite}"
    if not (root / "etc" / "debian_version").exists():
        command = ["debootstrap", "--variant=minbase", suite, str(root)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        for archive in (root / "var" / "cache" / "apt" / "archives").glob("*.deb"):
            archive.unlink()
    return root


def _take(step: Step, image: Image, context: Path, images: Mapping[str, Image]) -> None:
    if step.keyword == "RUN":
        done = _enter(image, ["/bin/sh", "-c", step.text], f'{MOUNTS}cp {CERTIFICATES} "$0/run"\n', "0:0")
        if done.returncode != 0:
            raise RuntimeError(f"exit code {done.returncode}: {step.text}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    elif step.keyword == "ENV":
        image.variables |= {name: _expand(value, image) for name, value in step.assignments().items()}
    elif step.keyword == "WORKDIR":
        image.folder = step.text
        (image.root / step.text.lstrip("/")).mkdir(parents=True, exist_ok=True)
    elif step.keyword == "COPY" and (source := step.option("from")) is not None:
        _copy(step.words(), image, images[source].root, [])
    elif step.keyword == "COPY":
        _copy(step.words(), image, context, ["--exclude=__pycache__"])
    elif step.keyword == "ENTRYPOINT":
        image.entry = step.words()
    elif step.keyword == "CMD":
        image.command = step.words()


def _expand(value: str, image: Image) -> str:
    for name, known in image.variables.items():
        value = value.replace(f"${name}", known)
    return value


def _copy(words: Sequence[str], image: Image, origin: Path, options: Sequence[str]) -> None:
    """Copy as Docker's layers do: times in whole seconds, owned by root."""
    *sources, target = words
    base = image.root / str(Path(image.folder) / target).lstrip("/")
    for source in sources:
        place = origin / source.lstrip("/")
        if place.is_dir():
            base.mkdir(parents=True, exist_ok=True)
            packing = ["tar", "-C", str(place), "--format=gnu", "--owner=0", "--group=0", *options, "-c", "."]
            with subprocess.Popen(packing, stdout=subprocess.PIPE) as tar:
                subprocess.run(["tar", "-C", str(base), "-x"], check=True, stdin=tar.stdout)
        else:
            end = base / place.name if target.endswith("/") else base
            end.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(place, end)


def _enter(
    image: Image, command: Sequence[str], mounts: str, user: str, *without: str
) -> subprocess.CompletedProcess[str]:
    """Run a command in a root, with mounts that end with it."""
    inner = f"cd {shlex.quote(image.folder)} && exec {shlex.join(command)}"
    chroot = f'exec {shutil.which("chroot")} --userspec={user} "$0" /bin/sh -c {shlex.quote(inner)}'
    script = f"set -e\n{mounts.replace('SHARED', str(SHARED_MEMORY_MB))}{chroot}"
    registries = {"PIP_CERT": f"/run/{CERTIFICATES.name}", "DEBIAN_FRONTEND": "noninteractive"}
    return subprocess.run(
        ["unshare", "--mount", "--pid", "--fork", *without, "/bin/sh", "-c", script, str(image.root)],
        env={**({} if without else registries), **image.variables},
        capture_output=True,
        text=True,
        check=False,
    )
