// Measure multiply-add and copy rates of a device, as a scale for other shaders.

struct Parameters { count: u32, rounds: u32 }
@group(0) @binding(0) var<uniform> u: Parameters;
@group(0) @binding(1) var<storage, read> source: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> destination: array<vec4f>;

// Four chains of vec4 multiply-adds, with u.rounds operations each.
@compute @workgroup_size(LANES)
fn multiply_add(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count) { return; }
    let by = source[i] + 0.999;
    var a = by;
    var b = by + 1.0;
    var c = by + 2.0;
    var d = by + 3.0;
    for (var k = 0u; k < u.rounds; k++) {
        a = fma(a, by, by);
        b = fma(b, by, by);
        c = fma(c, by, by);
        d = fma(d, by, by);
    }
    destination[i] = a + b + c + d;
}

@compute @workgroup_size(LANES)
fn copy(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i < u.count) { destination[i] = source[i]; }
}
