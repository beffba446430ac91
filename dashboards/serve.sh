#!/bin/sh
# Entry point of the dashboard's image: the run while it is on, then its recording, at the same address, until it is stopped.
# (A viewer that was open during the run keeps what it has; one that is opened or reloaded later gets the whole recording.)
trap 'exit 0' TERM INT
echo "dashboard: http://localhost:9877/?url=rerun%2Bhttp://localhost:9876/proxy"
"$@" &
wait $! || echo "the dashboard ended with status $?"
[ -s "$PALPATE_OUT/recording.rrd" ] || exit 1
echo "the run is over; its recording stays at the same address until this container is stopped"
exec rerun --serve-web --port 9876 --web-viewer-port 9877 "$PALPATE_OUT/recording.rrd"
