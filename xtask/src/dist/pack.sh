# SPDX-License-Identifier: MIT OR Apache-2.0
# A task of `cargo xtask dist`, which sets the variables: programs of $BUILT and documents of $REPOSITORY become packages in $OUT.
umask 022
files=$OUT/work/files doc=share/doc/tautline
mkdir -p "$OUT/work"
# What it is, as the README begins: a paragraph, and its first sentence.
about=$(sed -n '3,/^$/p' "$REPOSITORY/README.md") first=$(sed -n '3s/\. .*//p' "$REPOSITORY/README.md")

# Whether it is this machine's programs that are packed.
is_own() { [ "$BUILT" = "$HERE" ]; }

# $1 is the project, $2 its summary; the rest are more fields. The folder $wheel is packed.
pack_wheel() {
    name=$1 summary=$2 module=$(echo "$1" | tr - _)
    shift 2
    info=$wheel/$module-$VERSION.dist-info
    mkdir -p "$info/licenses" "$OUT/pypi"
    cp "$REPOSITORY/LICENSE-MIT" "$REPOSITORY/LICENSE-APACHE" "$info/licenses"
    case $name in taut) notices=notices ;; *) notices=rmw-notices ;; esac
    cp "$OUT/work/$notices.txt" "$info/licenses/THIRD-PARTY-NOTICES.txt"
    # What `cargo xtask dist --only sbom` has made.
    case $name in taut) sbom=taut ;; *) sbom=rmw_tautline ;; esac
    if [ -d "$OUT/sbom" ] && is_own; then mkdir "$info/sboms" && cp "$OUT/sbom/$sbom"*.cdx.json "$info/sboms"; fi
    { cat <<END
Metadata-Version: 2.4
Name: $name
Version: $VERSION
Summary: $summary
License-Expression: MIT OR Apache-2.0
License-File: LICENSE-MIT
License-File: LICENSE-APACHE
License-File: THIRD-PARTY-NOTICES.txt
Keywords: robotics,ros2,real-time,middleware,shared-memory
Classifier: Operating System :: POSIX :: Linux
Project-URL: Repository, https://github.com/tautline/tautline
Description-Content-Type: text/markdown
END
        [ $# = 0 ] || printf '%s\n' "$@"
    } > "$info/METADATA"
    # What pip takes where no wheel fits: it says why.
    source=$OUT/work/$module-$VERSION
    rm -rf "$source"
    mkdir "$source"
    cp "$info/METADATA" "$source/PKG-INFO"
    case $name in taut) machines="x86_64 or aarch64" ;; *) machines=$MACHINE ;; esac
    sed "s/@NAME@/$name/; s/@VERSION@/$VERSION/; s/@MACHINES@/$machines/; s/@GLIBC@/$GLIBC/" \
        "$REPOSITORY/xtask/src/dist/no_wheel.py" > "$source/no_wheel.py"
    printf '[build-system]\nrequires = []\nbuild-backend = "no_wheel"\nbackend-path = ["."]\n' > "$source/pyproject.toml"
    # One for all machines: that of this one stays.
    sdist=$OUT/pypi/$module-$VERSION.tar.gz
    if is_own || [ ! -e "$sdist" ]; then archive "$sdist" "$OUT/work" "$module-$VERSION"; fi
    { echo; cat "$REPOSITORY/README.md"; } >> "$info/METADATA"
    printf 'Wheel-Version: 1.0\nGenerator: cargo xtask dist\nRoot-Is-Purelib: false\nTag: py3-none-manylinux_%s_%s\n' \
        "$(echo "$GLIBC" | tr . _)" "$MACHINE" > "$info/WHEEL"
    rm -f "$OUT/pypi/$module-"*"_$MACHINE.whl"
    "$TOOLS/bin/wheel" pack "$wheel" --dest-dir "$OUT/pypi"
}

# The file $1 of what is named $3 in the folder $2.
archive() {
    tar --create --directory "$2" --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$SOURCE_DATE_EPOCH" "$3" |
        gzip -n "-$LEVEL" > "$1"
}

# The package $1 that depends on $2 and is in short $3, with its description as input. The folder $root is packed.
pack_deb() {
    folder=$root/usr/share/doc/$1 maintainer="The maintainers of Tautline <maintainers@tautline.invalid>"
    mkdir -p "$root/DEBIAN"
    printf '%s (%s) unstable; urgency=medium\n\n  * See CHANGELOG.md.\n\n -- %s  %s\n' "$1" \
        "$VERSION" "$maintainer" "$(date -Rud "@$SOURCE_DATE_EPOCH")" | gzip -9n > "$folder/changelog.gz"
    {
        printf 'Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\nUpstream-Name: tautline\n'
        printf 'Source: https://github.com/tautline/tautline\n\nFiles: *\nCopyright: %s\nLicense: Expat or Apache-2.0\n\n' \
            "$(sed -n 's/^Copyright (c) //p' "$REPOSITORY/LICENSE-MIT")"
        printf 'License: Expat\n'
        sed -n '/^Permission/,$ { s/^$/./; s/^/ /; p }' "$REPOSITORY/LICENSE-MIT"
        printf '\nLicense: Apache-2.0\n The text is in /usr/share/common-licenses/Apache-2.0.\n'
    } > "$folder/copyright"
    { cat <<END && cat
Package: $1
Version: $VERSION
Architecture: $ARCHITECTURE
Maintainer: $maintainer
Installed-Size: $(du -sk --exclude DEBIAN "$root" | cut -f1)
Depends: $2
Section: misc
Priority: optional
Homepage: https://github.com/tautline/tautline
Description: $3
END
    } > "$root/DEBIAN/control"
    find "$root" -exec touch --no-dereference --date="@$SOURCE_DATE_EPOCH" {} +
    cd "$root"
    find . -path ./DEBIAN -prune -o -type f -printf '%P\0' | LC_ALL=C sort -z | xargs -0 md5sum > DEBIAN/md5sums
    kind=$([ "$LEVEL" = 1 ] && echo gzip || echo xz)
    deb=$OUT/$1_${VERSION}_$ARCHITECTURE.deb
    # Those of other machines stay.
    rm -f "$OUT/$1_"*"_$ARCHITECTURE.deb"
    dpkg-deb --root-owner-group "-Z$kind" "-z$LEVEL" --build "$root" "$deb"
    # It takes longer than the rest.
    if [ "$LEVEL" = 1 ]; then return; fi
    if command -v lintian; then lintian --allow-root --fail-on error "$deb"; else echo "$deb: not checked: lintian is not installed"; fi
}

case $1 in
sbom) # Of a copy of what is committed: they are written beside each Cargo.toml.
    source=$OUT/work/source
    rm -rf "$source" "$OUT/sbom"
    mkdir -p "$OUT/sbom"
    git clone --quiet --shared "$REPOSITORY" "$source"
    for folder in "$source" "$source/rmw"; do
        cd "$folder"
        "$CYCLONEDX" cyclonedx --quiet --describe binaries --no-build-deps --format json --spec-version 1.5
    done
    for name in taut taut-bag taut-top taut-filter taut-gateway rmw_tautline; do
        find "$source" -name "${name}_[bc]*.cdx.json" -exec sed "s,$source,tautline,g" {} + > "$OUT/sbom/$name.cdx.json"
    done
    ;;
files) # As they are below /usr/local.
    rm -rf "$files"
    mkdir -p "$files/bin" "$files/$doc/examples" "$files/share/bash-completion/completions" \
        "$files/share/zsh/site-functions" "$files/share/fish/vendor_completions.d"
    for program in taut taut-bag taut-top taut-filter taut-gateway; do
        "$STRIP" -o "$files/bin/$program" "$BUILT/$program"
    done
    cd "$REPOSITORY"
    cp LICENSE-MIT LICENSE-APACHE README.md CHANGELOG.md docs/deployment.md "$files/$doc"
    gzip -9n < "$OUT/work/notices.txt" > "$files/$doc/THIRD-PARTY-NOTICES.gz"
    cp docs/systemd/* docs/realtime/* "$files/$doc/examples"
    # Found by its name: a script that completes it names it as it was started. It is this machine's, whatever machine the files are for.
    PATH=$HERE:$PATH
    taut man "$files/share/man/man1"
    gzip -9n "$files/share/man/man1/"*
    taut completions bash > "$files/share/bash-completion/completions/taut"
    taut completions zsh > "$files/share/zsh/site-functions/_taut"
    taut completions fish > "$files/share/fish/vendor_completions.d/taut.fish"
    ;;
tarball)
    folder=tautline-$VERSION-$MACHINE-unknown-linux-gnu
    rm -f "$OUT/tautline-"*"-$MACHINE-"*.tar.gz
    rm -rf "$OUT/work/$folder"
    cp -a "$files" "$OUT/work/$folder"
    archive "$OUT/$folder.tar.gz" "$OUT/work" "$folder"
    ;;
deb)
    root=$OUT/work/deb
    rm -rf "$root"
    mkdir -p "$root/usr/lib/systemd/system" "$root/usr/share/lintian/overrides"
    cp -a "$files/." "$root/usr"
    cd "$root/usr"
    mv share/zsh/site-functions share/zsh/vendor-completions
    sed 's,/usr/local/bin,/usr/bin,' "$doc/examples/taut-gateway@.service" > lib/systemd/system/taut-gateway@.service
    rm "$doc/LICENSE-MIT" "$doc/LICENSE-APACHE" "$doc/examples/taut-gateway@.service"
    # A translation of it to Rust; and a program that only taut starts.
    printf 'tautline: %s\n' "embedded-library libyaml *" "no-manual-page \[usr/bin/taut-filter\]" \
        > share/lintian/overrides/tautline
    pack_deb tautline "libc6 (>= $GLIBC), libgcc-s1" "$first" <<END
$(echo "$about" | fmt -w 78 | sed 's/^/ /')
 .
 The command taut observes, records and replays the topics of a robot, computes
 bounds of response times and compares them with measurements. The gateway
 connects hosts over Zenoh, and ROS 2 nodes on rmw_zenoh.
END
    ;;
rmw-deb) # For an installed ROS 2, as colcon registers it there.
    root=$OUT/work/rmw-deb ros=ros-$DISTRIBUTION
    prefix=$root/opt/ros/$DISTRIBUTION
    rm -rf "$root"
    mkdir -p "$prefix/lib" "$prefix/share/rmw_tautline" "$root/usr/share/doc/$ros-rmw-tautline" "$root/usr/share/lintian/overrides"
    "$STRIP" -o "$prefix/lib/librmw_tautline.so" "$BUILT/librmw_tautline.so"
    "$TOOLS/bin/patchelf" --force-rpath --set-rpath '$ORIGIN' "$prefix/lib/librmw_tautline.so"
    chmod 644 "$prefix/lib/librmw_tautline.so"
    cp "$REPOSITORY/rmw/package.xml" "$prefix/share/rmw_tautline"
    gzip -9n < "$OUT/work/rmw-notices.txt" > "$root/usr/share/doc/$ros-rmw-tautline/THIRD-PARTY-NOTICES.gz"
    c="rosidl_typesupport_c;rosidl_typesupport_fastrtps_c" cpp="rosidl_typesupport_cpp;rosidl_typesupport_fastrtps_cpp"
    for resource in "packages=" "rmw_typesupport=$c;$cpp" "rmw_typesupport_c=$c" "rmw_typesupport_cpp=$cpp"; do
        folder=$prefix/share/ament_index/resource_index/${resource%%=*}
        mkdir -p "$folder"
        printf %s "${resource#*=}" > "$folder/rmw_tautline"
    done
    # Where ROS's packages are.
    printf "$ros-rmw-tautline: %s\n" "dir-or-file-in-opt *" "custom-library-search-path *" \
        > "$root/usr/share/lintian/overrides/$ros-rmw-tautline"
    pack_deb "$ros-rmw-tautline" "libc6 (>= $GLIBC), libgcc-s1, libstdc++6, $ros-fastcdr, $ros-rcutils, $ros-rmw, \
$ros-rosidl-runtime-c, $ros-rosidl-typesupport-fastrtps-c, $ros-rosidl-typesupport-fastrtps-cpp" \
        "rmw_tautline for ROS 2 $DISTRIBUTION" <<END
 With RMW_IMPLEMENTATION=rmw_tautline, nodes of rclcpp, rclpy and others
 communicate through Tautline's shared memory, unchanged.
END
    ;;
wheel)
    wheel=$OUT/work/wheel
    data=$wheel/taut-$VERSION.data
    rm -rf "$wheel"
    mkdir -p "$data"
    cp -a "$files" "$data/data"
    mv "$data/data/bin" "$data/scripts"
    pack_wheel taut "$first: the command line and the gateway" "Requires-Python: >=3.8"
    ;;
rmw-wheel) # One for all distributions: the libraries that were packed for others are in it.
    wheel=$OUT/work/rmw-wheel
    rm -rf "$wheel/"*.dist-info
    mkdir -p "$wheel/rmw_tautline/$DISTRIBUTION"
    library=$wheel/rmw_tautline/$DISTRIBUTION/librmw_tautline.so
    "$STRIP" -o "$library" "$BUILT/librmw_tautline.so"
    # ROS's wheels have their libraries in lib of the environment, four folders up. What these need is found there, too.
    "$TOOLS/bin/patchelf" --force-rpath --set-rpath '$ORIGIN/../../../..' "$library"
    sed "s/@VERSION@/$VERSION/" "$REPOSITORY/xtask/src/dist/rmw_tautline.py" > "$wheel/rmw_tautline/__init__.py"
    # Files of this kind are read in the order of their names: after ros_wheels_bootstrapper.pth, which starts Python anew.
    echo "import os; os.environ.get('RMW_IMPLEMENTATION') == 'rmw_tautline' and __import__('rmw_tautline')" \
        > "$wheel/tautline_rmw.pth"
    # Those with whose headers and libraries they are built.
    case $(cd "$wheel/rmw_tautline" && echo */) in
    jazzy/) of=Jazzy rmw="~=7.3.2" rcutils="~=6.7.4" rosidl="~=4.6.6" fastcdr="~=2.2.5" ;;
    kilted/) of=Kilted rmw="~=7.8.2" rcutils="~=6.9.8" rosidl="~=4.9.5" fastcdr="~=2.3.3" ;;
    *) of="Jazzy and Kilted" rmw=">=7.3.2,<7.9" rcutils=">=6.7.4,<6.10" rosidl=">=4.6.6,<4.10" fastcdr=">=2.2.5,<2.4" ;;
    esac
    pack_wheel rmw-tautline "$first: rmw_tautline for ROS 2 $of" "Requires-Python: >=3.8" "Requires-Dist: ros-rmw$rmw" \
        "Requires-Dist: ros-rcutils$rcutils" "Requires-Dist: ros-rosidl-runtime-c$rosidl" "Requires-Dist: ros-fastcdr$fastcdr"
    ;;
esac
