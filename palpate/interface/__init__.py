"""What `import palpate` offers: patients without an arm, examinations, assessments and studies, from a notebook or a program."""
