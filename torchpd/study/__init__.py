"""Convergence studies, plots and reports."""

from .tasks import AXES, StudyOptions, contact_table, cost_table, paper_table, run_study, study_rows, study_table

__all__ = [
    "AXES",
    "StudyOptions",
    "contact_table",
    "cost_table",
    "paper_table",
    "run_study",
    "study_rows",
    "study_table",
]
