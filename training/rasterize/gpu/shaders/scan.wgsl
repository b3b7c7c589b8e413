// Exclusive prefix sums of unsigned integers, in place. One workgroup scans up to a few thousand values. Longer arrays
// are summed in blocks of 1024, and the prefix sum of the blocks is added in the end. Sums that exceed 32 bits are the
// largest number, so millions of splats in thousands of tiles are not taken for few pairs.

struct Parameters { count: u32 }
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;  // sum of each block
@group(0) @binding(3) var<storage, read> starts: array<u32>;  // sum before each block

const PER_LANE: u32 = 16;  // consecutive values per invocation
const BLOCK: u32 = LANES * PER_LANE;
var<workgroup> lane_sums: array<u32, LANES>;

fn add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// Sum the values of each invocation; call in uniform control flow.
fn sum_lanes(block: u32, lane: u32) {
    var sum = 0u;
    let first = block * BLOCK + lane * PER_LANE;
    for (var k = first; k < min(first + PER_LANE, u.count); k++) { sum = add(sum, values[k]); }
    workgroupBarrier();
    lane_sums[lane] = sum;
    workgroupBarrier();
}

// Return the sum of all invocations before this one.
fn sum_before(lane: u32) -> u32 {
    var sum = 0u;
    for (var k = 0u; k < lane; k++) { sum = add(sum, lane_sums[k]); }
    return sum;
}

fn write_sums(block: u32, lane: u32, start: u32) {
    var at = add(start, sum_before(lane));
    let first = block * BLOCK + lane * PER_LANE;
    for (var k = first; k < min(first + PER_LANE, u.count); k++) {
        let value = values[k];
        values[k] = at;
        at = add(at, value);
    }
}

@compute @workgroup_size(LANES)
fn total(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    sum_lanes(block, lane);
    if (lane == 0u) { totals[block] = sum_before(LANES); }
}

@compute @workgroup_size(LANES)
fn scan_blocks(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    sum_lanes(block, lane);
    write_sums(block, lane, starts[block]);
}

@compute @workgroup_size(LANES)
fn scan_all(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    var done = 0u;
    for (var block = group_of(group); block * BLOCK < u.count; block++) {
        sum_lanes(block, lane);
        write_sums(block, lane, done);
        done = add(done, sum_before(LANES));
    }
}
