_talk_completion() {
    local IFS=$'\n' program=$1 line
    [[ $program == '~/'* ]] && program=$HOME/${program:2}
    COMPREPLY=()
    while IFS= read -r line; do
        case $line in
            file) compopt -o default 2>/dev/null ;;
            plain,*) COMPREPLY+=("${line#*,}") ;;
        esac
    done < <(COMP_WORDS=${COMP_LINE:0:COMP_POINT} COMP_CWORD=$2 _TALK_COMPLETE=bash_complete "$program" 2>/dev/null)
}

complete -o nosort -F _talk_completion talk 2>/dev/null || complete -F _talk_completion talk
