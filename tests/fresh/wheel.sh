# shellcheck shell=bash
# Test the wheel with bash and these variables. The first run builds it from CHECKOUT and installs it in PLACE.
# LIBRARY is the source of libespeak-ng that `talk doctor` must print, or empty. BEFORE_PIP is "linux32" on a 32-bit
# system, otherwise empty.
set -euo pipefail
cd "$(dirname "$PLACE")"
if [ ! -d "$PLACE" ]; then
    python3 -m venv "$PLACE"
    ${BEFORE_PIP:-} "$PLACE/bin/pip" wheel -q --no-deps -w "$PLACE/dist" "$CHECKOUT"
    ${BEFORE_PIP:-} "$PLACE/bin/pip" install -q "$PLACE"/dist/talkcli-*.whl
fi
talk=$PLACE/bin/talk
"$talk" --version

# serve OPTION…: starts a server and waits until it answers. $server is its process id.
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
# Three times, because libespeak-ng groups the events of the first sentence differently.
for _ in 1 2 3; do
    words=$("$talk" --json say -wf -- "battery low" | sed -n 's/.*"event": "word".* "word": "\([^"]*\)".*/\1/p')
    echo "words: ${words//$'\n'/ }"
    [ "$words" = $'battery\nlow' ] || exit 1
done
kill "$server"
wait "$server"
