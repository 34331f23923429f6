# shellcheck shell=bash
# What the scripts of this folder share: the checkout, README's words, the loudspeaker, the clock, and a folder for all
# of it ($top), which is gone at the end however that comes, unless $keep is set. To be sourced.

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
    # One file system: should something be mounted in it after all, that is not emptied.
    rm -rf --one-file-system "$top"
}
trap finish EXIT
trap 'exit 130' INT
trap 'exit 143' TERM

fail() { printf 'FAILED: %s\n' "$*" >&2; exit 1; }
now() { date +%s.%N; }
seconds() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.1f", b - a }'; }

# step NAME COMMAND…: runs it, and says how long it took. One that fails ends the script.
step() {
    local name=$1 began
    shift
    printf '\n== %s\n' "$name"
    began=$(now)
    "$@" || fail "$name"
    printf '== %s: %s s\n' "$name" "$(seconds "$began" "$(now)")" | tee -a "$summary"
}

# checkout DIR: what a clone of this repository holds, as it was committed last.
checkout() {
    mkdir -p "$1"
    git -C "$repository" archive HEAD | tar -x -C "$1"
}

# The README's words, from the checkout in DIR. Each function fails if the README no longer has them.
readme_command() { grep -m 1 -E '^python3 -m venv .*talk serve.* say "' "$1/README.md"; }
readme_tests() { grep -m 1 -E '^python3 -m venv .*pytest -n [0-9]+$' "$1/README.md"; }
readme_packages() { tr '\n' ' ' < "$1/README.md" | grep -oE 'sudo apt-get [a-z0-9.+ &-]*' | grep -m 1 -w -e "$2"; }
# readme_block DIR HEADING: the lines of all shell examples under this heading.
readme_block() {
    awk -v heading="$2" '/^#/ && !block { here = $0 == heading } /^```/ { block = /^```sh$/; next } here && block' \
        "$1/README.md" | grep .
}
readme_sentence() { readme_command "$1" | grep -oP ' say "\K[^"]+'; }

# listen DIR: a loudspeaker in DIR, which everybody may use; what comes out of it goes into the file DIR/heard.
listen() {
    mkdir -p "$1"
    chmod 755 "$1"
    rm -f "$1/fifo" "$1/heard"
    mkfifo "$1/fifo"
    chmod 666 "$1/fifo"
    python3 "$here/sound.py" listen "$1/fifo" "$1/heard" > "$1/times" &
    loudspeaker=$!
}

# deaf DIR: takes the loudspeaker away; DIR/times says when the first and the last sound was heard.
deaf() {
    kill "$loudspeaker"
    wait "$loudspeaker"
    loudspeaker=
}

# heard DIR SINCE TEXT WAV [HOW]: prints how long after SINCE the text was heard, and compares the sound with WAV.
# HOW is the command of sound.py, "compare" if not given.
heard() {
    local first last
    read -r first last < "$1/times"
    printf '== heard "%s": its first sample after %s s, all after %s s\n' \
        "$3" "$(seconds "$2" "$first")" "$(seconds "$2" "$last")" | tee -a "$summary"
    python3 "$here/sound.py" "${5:-compare}" "$1/heard" "$4" | tee -a "$summary"
}

# asoundrc FIFO: ALSA's settings for a machine whose only device is that loudspeaker.
asoundrc() {
    printf 'pcm.!default { type file file "%s" format raw slave.pcm "null" }\npcm.null { type null }\n' "$1"
}

# in_short: the end of the output, the steps and what was heard once more.
in_short() { printf '\n-- in short\n' && cat "$summary"; }
