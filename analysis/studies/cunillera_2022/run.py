"""The study of Cunillera et al. (2022): its answers as trajectories, pictures and tables."""

from __future__ import annotations

from analysis.studies.cunillera_2022 import figures, model as study
from analysis.studies.cunillera_2022.figures import others_charts
from analysis.studies.report import StudyReport
from trainlog.formats.railway import write_trajectory
from trainlog.railway import Trajectory


def main(report: StudyReport, cells: int) -> None:
    """Optimise for each configuration alone and for all, and judge every answer.

    Parameters
    ----------
    report : StudyReport
    cells : int
        Of the grid.
    """
    level, slope, chosen = study.level(), study.downhill(), study.configurations()
    asked = study.questions(level, slope, chosen)
    answers: dict[str, Trajectory] = {}
    for name, (instance, some, braking) in report.track(asked.items(), "optimising"):
        answers[name] = found = study.solved(instance, some, braking, cells=cells)
        path = report.folder / f"{name}.json"
        write_trajectory(found, path)
        report.keep(path)
        report.draw({f"{name}.png": found.charts(line=instance.line)})
    ends = [
        study.end_of(level, share, cells=cells)
        for share in report.track(study.SHARES, "lowest common end speeds")
    ]
    alone = {each.name: answers[f"level-{each.name}"] for each in chosen}
    common, recourse = answers["level-common"], answers["level-recourse"]
    nominal = alone[study.NOMINAL]
    report.draw({"nominal-driven-by-others.png": others_charts(level, nominal, common, chosen)})
    on_level = [pair for pair in answers.items() if pair[1].line == level.line.name]
    report.show(
        figures.configurations_table(level),
        figures.price_table(alone, common, recourse),
        figures.printed_table(level, common),
        figures.phases_table(list(answers.items())),
        figures.cruise_table(on_level),
        figures.others_table(level, nominal, common, chosen),
        figures.ends_table(ends),
    )
