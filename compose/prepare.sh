#!/bin/sh
# The first container of a run, started as root: makes the results folder writable for the services' user and writes the scenario
# files as that user. PALPATE_SETTINGS has overrides a.b=c, separated by spaces. Services that may not know the patient get a volume
# with their own file.
set -euf
chmod 1777 /results
for setting in ${PALPATE_SETTINGS:-}; do
    set -- "$@" --set "$setting"
done
setpriv --reuid "$PALPATE_UID" --regid "$PALPATE_GID" --clear-groups \
    palpate prepare "$PALPATE_SCENARIO_NAME" --out /results "$@"
cp /results/exam.yaml /exam/
cp /results/plant.yaml /plant/
