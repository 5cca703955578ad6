#!/usr/bin/env bash
# That the sanitizers are in every object that we wrote: a flag at the linker alone would run nothing.
set -euo pipefail
folder=$1
count=0
while IFS= read -r object; do
    symbols=$(nm "$object")
    # A file with nothing but tables, or that never touches memory of others, has neither.
    if grep -q ' [Tt] ' <<<"$symbols" && ! grep -qE '__(asan|ubsan)_' <<<"$symbols"; then
        echo "$object: no sanitizer in it"
        exit 1
    fi
    grep -q __ubsan_ <<<"$symbols" && count=$((count + 1))
done < <(find "$folder/firmware" "$folder/bridge" "$folder/autonomy" "$folder/dbc" "$folder/plant_fmu" -name '*.c.o')
echo "UBSan is in $count objects"
((count > 0))
