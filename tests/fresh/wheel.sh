# shellcheck shell=bash
# What a machine does with the wheel: made and installed once, in PLACE, from CHECKOUT; tried each time. LIBRARY is
# where `talk doctor` must say that libespeak-ng came from, or empty. bash runs it, with these three as variables.
set -euo pipefail
cd "$(dirname "$PLACE")"
if [ ! -d "$PLACE" ]; then
    python3 -m venv "$PLACE"
    "$PLACE/bin/pip" wheel -q --no-deps -w "$PLACE/dist" "$CHECKOUT"
    "$PLACE/bin/pip" install -q "$PLACE"/dist/talkcli-*.whl
fi
talk=$PLACE/bin/talk
"$talk" --version

# serve OPTION…: starts a server, and returns when it answers; its process is $server.
serve() {
    "$talk" serve "$@" &
    server=$!
    "$talk" --connect-timeout 10 status > /dev/null
}

serve
"$talk" doctor --silent | tee "$PLACE/doctor.txt"
grep -E "^done +libespeak-ng .*\($LIBRARY.*\)" "$PLACE/doctor.txt" > /dev/null
kill "$server"
wait "$server"

serve --player null
"$talk" say -w -- "battery low"
kill "$server"
wait "$server"
