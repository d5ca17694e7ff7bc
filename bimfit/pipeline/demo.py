"""The demonstration: the paper's experiment on the packaged sample, from IFC file to gap mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bimfit.config import Config
from bimfit.pipeline.accuracy import accuracy_table, joint_errors, table_text, time_text
from bimfit.pipeline.compare import Comparison, comparison_table, run_methods, write_comparison
from bimfit.pipeline.deliver import Deliverables, deliver
from bimfit.pipeline.fit import fit_joint
from bimfit.pipeline.records import JointResult
from bimfit.pipeline.samples import sample_model
from bimfit.pipeline.simulate import designed, simulate
from bimfit.pipeline.survey import cut_joint, model_joints, survey
from bimfit.scan.formats import write_scan
from bimfit.simulation.accuracy import GapErrors
from bimfit.simulation.motion import random_truth
from bimfit.simulation.rangefinder import simulate_scan
from bimfit.simulation.scenario import Scenario
from bimfit.simulation.truth import write_truth

SAMPLE = "square-butt-ifc4.ifc"
METHODS = ("grcsm", "search", "paper", "mrcsm", "icp-point", "icp-plane")
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class DemoResult:
    """What the demonstration prints.

    Attributes
    ----------
    accuracy, times, comparison : str
        Tables.
    lost, far : int
        Stations without an estimate, and estimates more than 10 mm off.
    files : tuple of Path
    """

    accuracy: str
    times: str
    comparison: str
    lost: int
    far: int
    files: tuple[Path, ...]


def demo(
    folder: Path,
    *,
    joints: int = 20,
    seed: int = 0,
    methods: Sequence[str] = METHODS,
    report: bool = True,
    progress: Progress = lambda step, share: None,
) -> DemoResult:
    """Run the paper's experiment: files and pictures for one joint, accuracy over many, methods side by side.

    Parameters
    ----------
    folder : Path
        Where scan, truth, results and pictures go.
    joints : int
        How many random joints the accuracy table is over.
    seed : int
        Of the first; the k-th uses ``seed + k``.
    report : bool
        Whether report.html is written.
    """
    model_path, config, scenario = sample_model(SAMPLE), Config(), Scenario()
    progress("simulating a scan", 0.0)
    scan, truths = simulate(model_path, scenario, seed)
    scan_path, truth_path = folder / "scan.csv", folder / "truth.json"
    write_scan(scan, scan_path)
    write_truth(truths, truth_path, model=model_path, scan=scan_path)
    result = survey(model_path, scan_path, config, joints=[truths[0].id], progress=progress)
    written, _ = deliver(result, folder, Deliverables(report=report), progress, {truths[0].id: truths[0]})
    files = [*written]
    fits, errors = accuracy_run(model_path, scenario, config, range(seed, seed + joints), progress)
    model, found = model_joints(model_path, config.joints, [truths[0].id])
    cut = cut_joint(model, found[0], scan, config)
    compared = Comparison(run_methods([cut], config, methods, truths, progress), "truth", (model_path,))
    files += write_comparison(compared, folder)
    return DemoResult(
        table_text(accuracy_table(errors), f"bimfit, {joints} joints"),
        time_text(fits),
        comparison_table(compared),
        sum(e.lost for e in errors),
        sum(int((e.position[e.estimated] > 0.010).sum()) for e in errors),
        (scan_path, truth_path, *files),
    )


def accuracy_run(
    model_path: Path, scenario: Scenario, config: Config, seeds: Sequence[int], progress: Progress
) -> tuple[list[JointResult], list[GapErrors]]:
    """Simulate and fit the model's longest joint once for each seed, in memory."""
    from bimfit.pipeline.simulate import longest_open

    model, found = model_joints(model_path, config.joints)
    joint = longest_open(found)
    sections = designed(model, joint, scenario)
    fits, errors = [], []
    for k, seed in enumerate(seeds):
        progress("accuracy over random joints", k / len(seeds))
        truth = random_truth(
            sections, scenario, seed, joint_id=joint.id, elements=joint.elements, kind=joint.kind
        )
        scan = simulate_scan(sections, truth, scenario, seed)
        fits.append(fit_joint(*cut_joint(model, joint, scan, config), config, threads=1))
        errors.append(joint_errors(fits[-1], truth))
    return fits, errors
