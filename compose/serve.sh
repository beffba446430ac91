#!/bin/sh
# Entry point of the dashboard's image: the run while it is on, then its recording, at the same address, until it is stopped.
# (A viewer that was open during the run keeps what it has; one that is opened or reloaded later gets the whole recording.)
export PALPATE_VIEWER=serve:0.0.0.0:9876 # here and not in the compose file: a run without containers would take the port from another one
"$@" &
service=$!
trap 'kill $service; exit 0' TERM INT
wait $service || echo "dashboard: its service ended with status $?"
[ -s "$PALPATE_OUT/recording.rrd" ] || exit 1
rerun analytics disable >/dev/null 2>&1
echo "dashboard: the run is over; its recording is at http://localhost:9877/?url=rerun%2Bhttp://localhost:9876/proxy"
exec rerun --serve-web --port 9876 --web-viewer-port 9877 "$PALPATE_OUT/recording.rrd" 2>/dev/null
