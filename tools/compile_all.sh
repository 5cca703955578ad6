#!/usr/bin/env bash
# Compile all C with -Werror by every compiler present. The cross compiler takes the firmware only: no port, no host parts.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$PWD/.venv/bin/python

for compiler in gcc clang; do
    command -v "$compiler" >/dev/null || { echo "$compiler: not present, not compiled"; continue; }
    cmake -S . -B "build/warnings-$compiler" -G Ninja -DCMAKE_C_COMPILER="$compiler" -DRACELOOP_WERROR=ON \
        -DPython_EXECUTABLE="$python" >/dev/null
    cmake --build "build/warnings-$compiler" >"build/warnings-$compiler.log" 2>&1 ||
        { cat "build/warnings-$compiler.log"; exit 1; }
    echo "$compiler: clean"
done

if ! command -v arm-none-eabi-gcc >/dev/null; then
    echo "arm-none-eabi-gcc: not present, not compiled"
elif ! arm-none-eabi-gcc -E -include string.h -x c /dev/null >/dev/null 2>&1; then
    echo "arm-none-eabi-gcc: has no C library (Debian: libnewlib-arm-none-eabi), not compiled"
else
    generated=$(ls -d build/warnings-gcc build/warnings-clang 2>/dev/null | head -n 1)
    objects=build/cortex-m
    rm -rf "$objects" && mkdir -p "$objects"
    for source in firmware/common/*.c firmware/obc/*.c firmware/raptor/*.c firmware/space_drive/*.c \
        "$generated"/generated/{parameter_table,fault_table,codec_table,raptor,raptor_v26,space_drive,sensors,autonomy}.c; do
        arm-none-eabi-gcc -mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard -std=c11 -Os -ffunction-sections \
            -Wall -Wextra -Wpedantic -Wconversion -Werror -ffp-contract=off -Ifirmware -I"$generated" \
            -c "$source" -o "$objects/$(echo "$source" | tr / _).o"
    done
    echo "arm-none-eabi-gcc: clean"
    arm-none-eabi-size -t "$objects"/*.o | tail -n 1
fi
