#!/usr/bin/env bash
# Makes anew what docs/results/README.md claims, but for what a GPU said. One core a run.
#
#   DATA=FOLDER benchmarks/reproduce.sh            lists the rows, and how long each and all take
#   DATA=FOLDER benchmarks/reproduce.sh NAME ...   takes these, or all of a folder; `all` takes all
#
# FOLDER has the scenes. Needs a clean commit and an idle core. Stopped, the same command goes on. In the
# end the results are in docs/results, its tables are made anew, and a test compares numbers in texts.
set -euo pipefail
cd "$(dirname "$0")/.."
export PATH="$PWD/.venv/bin:$PATH" OMP_NUM_THREADS=1
small="castle-P30 fox caliterra bonsai"
two_seeds="--seeds 0 1"

rows() { # by the name, minutes, then `abcd`'s command, with the scene's name for its folder
    local row=$1 scene photos seed
    for scene in $small; do
        trained splatfacto/$scene 25 $scene 4 --steps 4000 --methods abcd-monolithic splatfacto-scaled $two_seeds
    done
    trained splatfacto/fox-shipped 40 fox 4 --steps 30000 --methods splatfacto --evals 15
    trained splatfacto/castle-P30-640 40 castle-P30 1 --steps 3000 --methods abcd-monolithic splatfacto-scaled
    trained splatfacto/castle-P30-640-longer 20 castle-P30 1 --steps 9000 --methods abcd-monolithic
    for scene in $small; do
        trained budgets/$scene 25 $scene 4 --steps 4000 --budgets 1/4 1/8 1/16 --methods abcd $two_seeds
    done
    trained budgets/castle-P30-640 85 castle-P30 1 --seconds 480 --budgets 1/4 1/8 --methods abcd $two_seeds
    trained budgets/bonsai-640 75 bonsai 1 --seconds 720 --budgets 1/4 1/8 --methods abcd
    for scene in castle-P30 fox caliterra; do
        trained equal-time/$scene 6 $scene 4 --seconds 60 --methods abcd-monolithic abcd --blocks 8 $two_seeds
    done
    trained equal-time/bonsai-320 13 bonsai 2 --seconds 300 --methods abcd-monolithic abcd --blocks 8
    trained equal-time/castle-P30-640 18 castle-P30 1 --seconds 420 --methods abcd-monolithic abcd --blocks 8
    trained blocks/castle-P30 12 castle-P30 4 --seconds 180 --methods abcd --blocks 1 8 32
    for scene in castle-P30 caliterra fox; do
        for photos in 12 3; do
            trained few/$scene-$photos 3 $scene-$photos 4 --steps 1500 --methods abcd-monolithic --seeds 0 1 2 \
                --vary training.recipe.dropout=0
        done
    done
    trained coverage/land 12 land 1 --steps 4000 --methods abcd-monolithic abcd --blocks 2 8 --seeds 0 1 2
    trained coverage/caliterra 18 caliterra 4 --steps 4000 --methods abcd-monolithic abcd --blocks 2 8 --seeds 0 1 2
    trained gaussians 6 castle-P30 4 --seconds 45 --methods abcd-monolithic \
        --vary training.density.min-contribution={0,1,4,16,64}
    trained peers/castle-P30-eighth 8 castle-P30 4 --steps 4000 --budgets 1/8 --methods abcd abcd-partition abcd-ablated
    $row memory 5 compare --tiles 2 8 32 64 512 --methods abcd abcd-monolithic
    for seed in 0 1 2 3; do
        $row stability/seed-$seed 2 stability --seed $seed
    done
}

trained() { # on a scene, by its name, and a reduction of its photos
    $row "$1" "$2" compare --data "$3" --downscale "$4" "${@:5}"
}

list() {
    printf '%-26s %3d min   abcd %s\n' "$1" "$2" "${*:3}"
}

with_few_photos() { # of those that are not held out, evenly spaced: as many as the name ends with
    local from=$DATA/${1%-*} to=$out/data/$1
    mkdir -p "$to"
    ln -sfn "$(realpath "$from/images")" "$to/images"
    ln -sfn "$(realpath "$from/sparse")" "$to/sparse"
    LC_ALL=C ls "$from/images" | awk 'NR % 8 == 1' > "$to/test_list.txt"
    LC_ALL=C ls "$from/images" | awk -v few="${1##*-}" 'NR % 8 != 1 {name[n++] = $0}
        END {for (i = 0; i < few; i++) print name[int((i + 0.5) * n / few)]}' > "$to/train_list.txt"
    echo "$to"
}

take() {
    local name=$1 words=("${@:3}") scene=${*:5:1} wanted
    for wanted in $asked; do
        [[ $wanted == all || $name == "$wanted" || $name == "$wanted"/* ]] || continue
        if [[ $4 == --data ]]; then
            words[2]=$DATA/$scene
            [[ ! $scene =~ -(12|3)$ ]] || words[2]=$(with_few_photos "$scene")
            words+=(--pictures "$([[ -f docs/results/$name.jpg ]] && echo 1 || echo 0)")
        fi
        abcd "${words[@]}" --out "$out/$name" || [[ $3 == stability ]] # 1 where a scenario fails
    done
}

collect() {
    local found=$out/$1 chart
    [[ ! -f $found/results.json ]] || install -D -m 644 "$found/results.json" "docs/results/$1.json"
    for chart in memory memory_accuracy; do # the second is of budgets only
        [[ ! -f $found/$chart.png || ! -f docs/results/$1.png ]] ||
            install -m 644 "$found/$chart.png" "docs/results/$1.png"
    done
    [[ ! -d $found/pictures || ! -f docs/results/$1.jpg ]] || python -c 'import sys; from PIL import Image
Image.open(sys.argv[1]).convert("RGB").save(sys.argv[2], quality=90)' "$found"/pictures/view-*.png "docs/results/$1.jpg"
}

if (($# == 0)); then
    rows list | awk '{print; minutes += $2} END {printf "%.0f hours in all\n", minutes / 60}'
    exit
fi
: "${DATA:?is the folder with the scenes: DATA=FOLDER $0 $*}"
if [[ -n $(git status --porcelain) ]]; then
    echo "Files differ from the commit, so nobody could do it again: commit them, or put them away." >&2
    exit 2
fi
asked=$* out=outputs/reproduced/$(git rev-parse --short HEAD)
rows take
rows collect
python -m benchmarks.tables
python -m pytest -q tests/test_documents.py
