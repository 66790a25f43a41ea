"""What a run that was trained on single views says of several: rendered where it is missing, recorded once."""

from dataclasses import dataclass

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.runs import RunFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered
from phd_exp.training.config import RenderedConfig, RunConfig


@dataclass(frozen=True)
class Several:
    """The scenes that several cameras see, for a run to be tried on after its training."""

    data: RenderedConfig
    spec: DatasetSpec
    scenes: int

    @classmethod
    def of(cls, checked: RunConfig) -> "Several | None":
        """What a configuration asks for; None where it asks for nothing."""
        asked = checked.evaluation.multiview
        if asked is None or asked.scenes == 0:
            return None
        assert isinstance(checked.data, RenderedConfig)  # as the configuration was checked
        return cls(checked.data, asked.spec_beside(checked.data.spec), asked.scenes)

    @property
    def folder(self) -> DatasetFolder:
        """The data set of these scenes, beside the one that the run was trained on."""
        return DatasetFolder(self.data.root / self.spec.variant)

    def require_possible(self) -> None:
        """Raise DatasetError where the folder holds another data set, before hours are spent on a run."""
        self.folder.missing(self.spec, 0, 0)

    def record(self, run: RunFolder, cores: int) -> None:
        """Render what is missing and record what the run says of it, unless that has been done."""
        from phd_exp.inference.several_views import is_recorded, record_views

        if is_recorded(run, self.spec, self.scenes):
            return
        ensure_rendered(self.folder, self.spec, 0, self.scenes * self.spec.views, self.data.workers, cores)
        if record_views(run, self.folder, self.spec, self.scenes):
            scenes = "1 scene" if self.scenes == 1 else f"{self.scenes} scenes"
            print(f"{run.views}: {scenes} seen by {self.spec.views} cameras each")
