"""What a stage is, and how its product is looked up."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar, cast

from sfm_app.errors import DamagedProductError, InputError
from sfm_app.photos import Source
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.workspace import Workspace

Product = TypeVar("Product")
Product_co = TypeVar("Product_co", covariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class Stage(Generic[Product_co]):
    """One step from photos to mesh."""

    name: str
    takes: tuple["Stage[object]", ...]
    """Stages whose products it needs."""
    settings: tuple[str, ...]
    """Settings, or tables of them, that its result depends on."""
    files: tuple[str, ...]
    """Its files and folders in the output folder; nothing else writes them."""
    make: Callable[["Products", RunContext], Product_co]
    load: Callable[["Products", RunContext], Product_co]
    """Reads the product that `make` has written."""
    digest: Callable[[Workspace], str]
    """Hashes what `load` reads; checked before anything is read, because COLMAP hangs or ends on damaged files."""
    grows: bool = False
    """Whether `make` can go on from what it made of other photos, see `runtime.earlier`."""

    @property
    def depends_on(self) -> frozenset[str]:
        """Names of all stages whose products its result depends on, directly or not."""
        return frozenset(name for stage in self.takes for name in (stage.name, *stage.depends_on))


class Products:
    """Products by stage; those of skipped stages are loaded on first use.

    Args:
        run: has the files to load them from.
        source: the user's photos or video; None where no product that depends on them is loaded.
    """

    def __init__(self, run: RunContext, source: Source | None = None) -> None:
        self._run, self._source = run, source
        self._known: dict[str, object] = {}

    @property
    def source(self) -> Source:
        """The user's photos or video."""
        if self._source is None:
            raise ValueError("the photos of a finished run are not read again")
        return self._source

    def __getitem__(self, stage: Stage[Product]) -> Product:
        """Return the product of a stage.

        Raises:
            DamagedProductError: the files of the stage have changed, or cannot be read.
        """
        if stage.name not in self._known:
            with check_undamaged(stage, self._run):
                self._known[stage.name] = stage.load(self, self._run)
        return cast(Product, self._known[stage.name])

    def keep(self, stage: Stage[Product], product: Product) -> None:
        """Keep the product that a stage has just made.

        Args:
            stage: the stage.
            product: its product.
        """
        self._known[stage.name] = product


@contextmanager
def check_undamaged(stage: Stage[object], run: RunContext) -> Iterator[None]:
    """Check the files of a stage, and turn errors of reading them in the block into one that names the stage.

    Args:
        stage: the one whose files are read in the block.
        run: has the files and the manifest.

    Raises:
        DamagedProductError: the files have changed, or cannot be read.
    """
    try:
        record = run.workspace.manifest.record(stage.name)
        if record is None or record.digest != stage.digest(run.workspace):
            raise ValueError(f"the files of stage `{stage.name}` have changed since it wrote them")
        yield
    except InputError:
        raise
    except Exception as err:  # decoders of damaged bytes raise all kinds of errors
        what = f"is not complete: {err.filename} is gone" if isinstance(err, FileNotFoundError) else "is damaged"
        left = f"what stage `{stage.name}` left in {run.workspace.root} {what}"
        raise DamagedProductError(left, resume_hint(run), stage.name) from err


def resume_hint(run: RunContext) -> str:
    """Say which command resumes a run."""
    return f"`sfm-app run PHOTOS -o {run.workspace.root}` resumes where it stopped"
