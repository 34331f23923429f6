function _talk_completion
    set -l program (string replace --regex '^~/' "$HOME/" -- (commandline -poc)[1])
    set -l typed (commandline -pc | string collect)
    for line in (COMP_WORDS=$typed COMP_CWORD= _TALK_COMPLETE=fish_complete $program 2>/dev/null)
        switch $line
            case file
                __fish_complete_path (commandline -ct)
            case 'plain,*'
                string replace 'plain,' '' -- $line
        end
    end
end

complete --no-files --command talk --arguments '(_talk_completion)'
