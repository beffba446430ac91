#!/bin/sh
# The first container of a run, started as root: makes the results folder writable for the services' user and writes the scenario
# files as that user. PALPATE_SETTINGS has overrides a.b=c, separated by spaces. Services that may not know the patient get a volume
# with their own file, and all get the run's key, which only that user can read.
set -euf
chmod 1777 /results /exam /plant
rm -f /results/run.key /exam/run.key /plant/run.key
for setting in ${PALPATE_SETTINGS:-}; do
    set -- "$@" --set "$setting"
done
setpriv --reuid "$PALPATE_UID" --regid "$PALPATE_GID" --clear-groups \
    palpate prepare "$PALPATE_SCENARIO_NAME" --out /results "$@"
cp /results/exam.yaml /exam/
cp /results/plant.yaml /plant/
setpriv --reuid "$PALPATE_UID" --regid "$PALPATE_GID" --clear-groups sh -euc '
    umask 077
    head -c 32 /dev/urandom > /results/run.key
    cp /results/run.key /exam/
    cp /results/run.key /plant/'
