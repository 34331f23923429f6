# shellcheck shell=bash
# Functions that the scripts in this folder share. Source this file. It also makes a temporary folder, $top, which is
# removed when the script ends, unless $keep is set.

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
repository=$(cd "$here/../.." && pwd)
top=$(mktemp -d)
summary=$top/summary
loudspeaker=

finish() {
    [ -z "$loudspeaker" ] || kill "$loudspeaker" || true
    if [ -n "${keep:-}" ]; then
        printf '\n%s is kept\n' "$top"
        return
    fi
    # --one-file-system: don't empty a file system that is still mounted in the folder.
    rm -rf --one-file-system "$top"
}
trap finish EXIT
trap 'exit 130' INT
trap 'exit 143' TERM

fail() { printf 'FAILED: %s\n' "$*" >&2; exit 1; }
now() { date +%s.%N; }
seconds() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.1f", b - a }'; }

# step NAME COMMAND…: runs the command and prints how long it took. If the command fails, the script ends.
step() {
    local name=$1 started_at
    shift
    printf '\n== %s\n' "$name"
    started_at=$(now)
    "$@" || fail "$name"
    printf '== %s: %s s\n' "$name" "$(seconds "$started_at" "$(now)")" | tee -a "$summary"
}

# checkout DIR: puts the files of the last commit into DIR.
checkout() {
    mkdir -p "$1"
    git -C "$repository" archive HEAD | tar -x -C "$1"
}

# The README's commands, from the checkout in DIR. Each function fails if the README no longer has the command.
readme_command() { grep -m 1 -E '^python3 -m venv .*talk serve.* say "' "$1/README.md"; }
readme_tests() { grep -m 1 -E '^python3 -m venv .*pytest -n [0-9]+$' "$1/README.md"; }
readme_packages() { tr '\n' ' ' < "$1/README.md" | grep -oE 'sudo apt-get [a-z0-9.+ &-]*' | grep -m 1 -w -e "$2"; }
# readme_block DIR HEADING: prints the lines of all shell examples under this heading.
readme_block() {
    awk -v heading="$2" '/^#/ && !block { here = $0 == heading } /^```/ { block = /^```sh$/; next } here && block' \
        "$1/README.md" | grep .
}
readme_sentence() { readme_command "$1" | grep -oP ' say "\K[^"]+'; }

# listen DIR: starts a loudspeaker in DIR that every user may play to. It writes the sound to DIR/heard.
listen() {
    mkdir -p "$1"
    chmod 755 "$1"
    rm -f "$1/fifo" "$1/heard"
    mkfifo "$1/fifo"
    chmod 666 "$1/fifo"
    python3 "$here/sound.py" listen "$1/fifo" "$1/heard" > "$1/times" &
    loudspeaker=$!
}

# stop_listening: stops the loudspeaker, which writes the times of the first and the last sound to DIR/times.
stop_listening() {
    kill "$loudspeaker"
    wait "$loudspeaker"
    loudspeaker=
}

# check_sound DIR SINCE TEXT WAV [COMMAND]: prints how long after SINCE the text was heard, and compares the sound with
# WAV. COMMAND is the command of sound.py, by default "compare".
check_sound() {
    local first last
    read -r first last < "$1/times"
    printf '== heard "%s": its first sample after %s s, all after %s s\n' \
        "$3" "$(seconds "$2" "$first")" "$(seconds "$2" "$last")" | tee -a "$summary"
    python3 "$here/sound.py" "${5:-compare}" "$1/heard" "$4" | tee -a "$summary"
}

# asoundrc FIFO: prints ALSA settings for a machine whose only device is this loudspeaker.
asoundrc() {
    printf 'pcm.!default { type file file "%s" format raw slave.pcm "null" }\npcm.null { type null }\n' "$1"
}

# print_summary: prints the steps and the sounds again, as the end of the output.
print_summary() { printf '\n-- summary\n' && cat "$summary"; }
