"""What `import palpate` offers: patients under the hand, examinations, assessments and studies, from a notebook or a program."""
