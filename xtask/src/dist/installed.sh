# SPDX-License-Identifier: MIT OR Apache-2.0
# What the `.deb` has put where, and that it takes all of it away: after the commands of docs/start.md, where they were run.
say "what is installed"
files=$(sudo dpkg -L tautline)
is_there() { case $files in *"
$1"*) ;; *) echo "there is no $1"; exit 1 ;; esac }
for file in lib/systemd/system/taut-gateway@.service share/bash-completion/completions/taut share/zsh/vendor-completions/_taut \
    share/fish/vendor_completions.d/taut.fish share/doc/tautline/examples/90-tautline.conf \
    share/doc/tautline/examples/90-tautline.rules; do is_there "/usr/$file"; done
gzip -dc /usr/share/man/man1/taut-topic-hz.1.gz | /usr/bin/grep '^\.TH "TAUT-TOPIC-HZ"'
/usr/bin/bash -euc '. /usr/share/bash-completion/completions/taut; complete -p taut'
# No unit is started, and nobody has got more rights.
for changed in /etc/systemd/system /etc/security/limits.d /etc/udev/rules.d; do
    if /usr/bin/grep -rl taut "$changed" 2>/dev/null; then echo "changed without being asked"; exit 1; fi
done
/usr/bin/grep '^ExecStart=/usr/bin/taut-gateway ' "/usr/lib/systemd/system/taut-gateway@.service"
/usr/bin/taut demo --seconds 2
/usr/bin/taut init installed.toml
/usr/bin/taut check installed.toml
sudo apt-get remove --yes --quiet tautline
for file in $files; do if [ ! -d "$file" ] && [ -e "$file" ]; then echo "$file is still there"; exit 1; fi; done
