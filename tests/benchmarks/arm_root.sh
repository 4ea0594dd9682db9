#!/bin/sh
# Builds the C extensions in a Debian arm64 system under qemu-user and compares its images with this computer's.
#
#     sudo tests/benchmarks/arm_root.sh FOLDER        about 2 GB and a quarter of an hour, once
#
# Needs: apt-get install debootstrap qemu-user-static gcc; an environment with tagid in .venv. The packages are
# unpacked without their installation scripts, which would take longer than all the rest under emulation.
set -eu
folder=$(realpath "$1")
cd "$(dirname "$0")/../.."
python=.venv/bin/python
root=$folder/root
mkdir -p "$folder"

binfmt=/proc/sys/fs/binfmt_misc
mountpoint -q $binfmt || mount -t binfmt_misc binfmt_misc $binfmt
if [ ! -e $binfmt/qemu-aarch64 ]; then
    magic='\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00'
    mask='\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff'
    printf '%s' ":qemu-aarch64:M::$magic:$mask:/usr/bin/qemu-aarch64-static:F" > $binfmt/register
fi

if [ ! -x "$root/usr/bin/python3" ]; then
    debootstrap --arch=arm64 --foreign --variant=minbase --include=python3,python3-dev,gcc,libc6-dev bookworm "$root"
    for package in "$root"/var/cache/apt/archives/*.deb; do dpkg -x "$package" "$root"; done
fi
mkdir -p "$root/opt/site" "$root/opt/tagid"
needed=$($python -c "import tomllib; print(*(d.replace(' ', '') for d in tomllib.load(open('pyproject.toml', 'rb'))['project']['dependencies']))")
# shellcheck disable=SC2086
$python -m pip install --quiet --upgrade --no-compile --target "$root/opt/site" --only-binary :all: \
    --implementation cp --python-version 3.11 --platform manylinux_2_28_aarch64 \
    --platform manylinux_2_27_aarch64 --platform manylinux_2_17_aarch64 --platform manylinux2014_aarch64 $needed
$python -m pip install --quiet --upgrade --no-compile --target "$root/opt/test" --only-binary :all: pytest
rm -rf "$root/opt/tagid"
mkdir -p "$root/opt/tagid"
cp -rL tagid models tests/benchmarks/arm_images.py "$root/opt/tagid/"
find "$root/opt/tagid/tagid" -name "*.so" -delete
$python - > "$root/opt/build.sh" <<'END'
import tomllib

with open("pyproject.toml", "rb") as file:
    extensions = tomllib.load(file)["tool"]["setuptools"]["ext-modules"]
for one in extensions:
    flags = " ".join(one["extra-compile-args"])
    place = one["name"].replace(".", "/")
    print(f"gcc -Wall {flags} -shared -fPIC -pthread -I/usr/include/python3.11 {' '.join(one['sources'])}"
          f" -o {place}.abi3.so -lm && echo {one['name']}")
END
chroot "$root" sh -ec "cd /opt/tagid && . /opt/build.sh"

tests="test_imaging_kernel test_loops reading/test_evidence reading/test_search"
mkdir -p "$root/opt/tagid/tests/unit/reading"
cp pyproject.toml "$root/opt/tagid/"
for name in $tests tags_synthetic reading/reader_scenes; do
    cp "tests/unit/$name.py" "$root/opt/tagid/tests/unit/$name.py"
done

export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
export PYTHONPATH="$PWD"
$python tests/benchmarks/arm_images.py make "$root/opt/captures"
$python tests/benchmarks/arm_images.py run "$root/opt/captures" "$folder/here.npz"
PYTHONPATH=/opt/tagid:/opt/site chroot "$root" python3 /opt/tagid/arm_images.py run /opt/captures /opt/arm64.npz
$python tests/benchmarks/arm_images.py compare "$folder/here.npz" "$root/opt/arm64.npz"
# Every loop against numpy on this processor; one test needs scipy.
PYTHONPATH=/opt/tagid:/opt/site:/opt/test chroot "$root" sh -c \
    "cd /opt/tagid/tests/unit && python3 -m pytest -c /dev/null --rootdir . -p no:cacheprovider -q -rs -k 'not matrix' ."
