# shellcheck shell=bash
# What a machine does with the wheel: made and installed once, in PLACE, from CHECKOUT; tried each time. LIBRARY is
# where `talk doctor` must say that libespeak-ng came from, or empty. BEFORE_PIP is "linux32" on a 32-bit system, else
# empty. bash runs the script with these four as variables.
set -euo pipefail
cd "$(dirname "$PLACE")"
if [ ! -d "$PLACE" ]; then
    python3 -m venv "$PLACE"
    ${BEFORE_PIP:-} "$PLACE/bin/pip" wheel -q --no-deps -w "$PLACE/dist" "$CHECKOUT"
    ${BEFORE_PIP:-} "$PLACE/bin/pip" install -q "$PLACE"/dist/talkcli-*.whl
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
grep -E "^ok +libespeak-ng .*\($LIBRARY.*\)" "$PLACE/doctor.txt" > /dev/null
kill "$server"
wait "$server"

serve --player null
# Three times: in the first sentence after the start, the events come in other groups than later.
for _ in 1 2 3; do
    words=$("$talk" --json say -wf -- "battery low" | sed -n 's/.*"event": "word".* "word": "\([^"]*\)".*/\1/p')
    echo "words: ${words//$'\n'/ }"
    [ "$words" = $'battery\nlow' ] || exit 1
done
kill "$server"
wait "$server"
