// Exclusive prefix sums of unsigned integers, in place, in blocks of 1024: the sum of each block, then the sums
// of what lies before each, then the blocks' own.

struct Parameters { count: u32 }
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;  // of each block, and of all

const EACH: u32 = 16;  // values that an invocation takes, one after the other
const BLOCK: u32 = LANES * EACH;
var<workgroup> shares: array<u32, LANES>;

fn sum_of(first: u32) -> u32 {
    var sum = 0u;
    for (var k = first; k < min(first + EACH, u.count); k++) { sum += values[k]; }
    return sum;
}

// The sum of the shares of the invocations before this one.
fn before(lane: u32) -> u32 {
    var sum = 0u;
    for (var k = 0u; k < lane; k++) { sum += shares[k]; }
    return sum;
}

@compute @workgroup_size(LANES)
fn blocks(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    shares[lane] = sum_of(block * BLOCK + lane * EACH);
    workgroupBarrier();
    if (lane == 0u) { sums[block] = before(LANES); }
}

// The one workgroup goes over all sums.
@compute @workgroup_size(LANES)
fn starts(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    if (group_of(group) > 0u) { return; }
    let blocks = (u.count + BLOCK - 1u) / BLOCK;
    var done = 0u;
    for (var first = 0u; first < blocks; first += BLOCK) {
        let mine = first + lane * EACH;
        var sum = 0u;
        for (var k = mine; k < min(mine + EACH, blocks); k++) { sum += sums[k]; }
        shares[lane] = sum;
        workgroupBarrier();
        var at = done + before(lane);
        for (var k = mine; k < min(mine + EACH, blocks); k++) {
            let value = sums[k];
            sums[k] = at;
            at += value;
        }
        done += before(LANES);
        workgroupBarrier();
    }
    if (lane == 0u) { sums[blocks] = done; }
}

@compute @workgroup_size(LANES)
fn spread(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group_of(group);
    let first = block * BLOCK + lane * EACH;
    shares[lane] = sum_of(first);
    workgroupBarrier();
    var at = sums[block] + before(lane);
    for (var k = first; k < min(first + EACH, u.count); k++) {
        let value = values[k];
        values[k] = at;
        at += value;
    }
}
