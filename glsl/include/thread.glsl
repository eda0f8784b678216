// Number of this thread in a dispatch of `Threads::Line` or `Threads::Counted`: long lines are folded into y. Macros,
// because gl_WorkGroupSize is known only behind the kernel's `layout(local_size_x = ...)`.
#define group_index() (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x)
#define thread_index() (group_index() * gl_WorkGroupSize.x + gl_LocalInvocationID.x)
