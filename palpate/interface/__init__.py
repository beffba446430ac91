"""The library: patients without an arm, examinations, assessments and studies for notebooks and programs."""
