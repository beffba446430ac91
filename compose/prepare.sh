#!/bin/sh
# The first container of a run, started as root: lets the services' user write into the results folder, whoever made it, and
# writes the scenario files there as that user. PALPATE_SETTINGS holds overrides a.b=c, separated by spaces. Who may not know
# the patient is given a volume with a file of its own.
set -euf
chmod 1777 /results
for setting in ${PALPATE_SETTINGS:-}; do
    set -- "$@" --set "$setting"
done
setpriv --reuid "$PALPATE_UID" --regid "$PALPATE_GID" --clear-groups \
    palpate prepare "$PALPATE_SCENARIO_NAME" --out /results "$@"
cp /results/exam.yaml /exam/
cp /results/plant.yaml /plant/
