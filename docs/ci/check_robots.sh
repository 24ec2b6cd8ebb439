#!/usr/bin/env bash
# Audits the robots that a change affects, and runs the stale goldens of twins. The GitHub Action,
# gitlab.yml and Jenkinsfile run it; it needs pytest-twin, git, and the history back to SINCE.
#
#   SINCE      revision with which the checkout is compared; empty, or of zeros: all robots
#   BASELINE   file of accepted findings
#   PACKAGES   NAME=DIR of package:// URLs, one on a line
#   TWINS      folders of twins, separated by spaces
#   RESULTS    folder for audit.sarif, audit.xml, reports/ and twin-*.xml
set -uo pipefail
results=${RESULTS:-pytest-twin-results}
mkdir -p "$results"
options=(--sarif "$results/audit.sarif" --junit "$results/audit.xml" --out "$results/reports")
if [[ -n ${SINCE:-} && ! $SINCE =~ ^0+$ ]]; then options+=(--since "$SINCE"); fi
if [[ -n ${BASELINE:-} ]]; then options+=(--baseline "$BASELINE"); fi
if [[ ${GITHUB_ACTIONS:-} == true ]]; then options+=(--annotate); fi
while IFS= read -r package; do
    if [[ -n $package ]]; then options+=(--package "$package"); fi
done <<<"${PACKAGES:-}"
status=0
pytest-twin audit-changes "${options[@]}" || status=$?
number=0
for twin in ${TWINS:-}; do
    number=$((number + 1))
    python -m pytest "$twin" --junitxml="$results/twin-$number.xml" \
        --twin-report="$results/twin-$number.html" || status=$?
done
exit "$status"
